"""The product's path: for each module how many of its mutants are drawn, and who should notice.

The tests are files under tests/. What other people's methods need (baselines) is not here.
"""

CENTRE = (
    "central/test_join_rule.py",
    "central/test_node.py",
    "central/test_tick_fold.py",
    "central/test_submap_set.py",
    "central/test_withdrawal.py",
    "central/test_confirmed.py",
)
JOIN = (
    "estimation/test_joining.py",
    "estimation/test_annealing.py",
    "estimation/test_landmark_weights.py",
    "estimation/test_sightings.py",
    "estimation/test_alignment.py",
    "estimation/test_minima.py",
)
WINDOW = ("estimation/test_window.py", "estimation/test_pose_nodes.py")

MODULES: dict[str, tuple[int, tuple[str, ...]]] = {
    "team/estimation/window.py": (12, (*WINDOW, "estimation/test_correlated_readings.py")),
    "team/estimation/fastslam.py": (8, ("estimation/test_fastslam.py", *WINDOW)),
    "team/estimation/fastslam_kernel.py": (8, ("estimation/test_fastslam.py",)),
    "team/estimation/landmark_kernel.py": (8, ("estimation/test_fastslam.py",)),
    "team/estimation/innovation.py": (6, ("estimation/test_innovation.py",)),
    "team/estimation/models.py": (8, ("estimation/test_models.py",)),
    "team/estimation/geometry.py": (6, ("estimation/test_geometry.py",)),
    "team/estimation/sensitivity.py": (6, ("estimation/test_sensitivity.py",)),
    "team/estimation/consensus.py": (12, ("estimation/test_consensus.py", "robot/test_gate.py")),
    "team/estimation/consensus_kernel.py": (10, ("estimation/test_consensus.py",)),
    "team/estimation/conditioning.py": (
        6,
        ("estimation/test_conditioning.py", "robot/test_team_map.py"),
    ),
    "team/estimation/whole_map.py": (
        10,
        ("estimation/test_whole_map.py", "estimation/test_conditioning.py"),
    ),
    "team/estimation/tie_kernel.py": (
        8,
        ("estimation/test_whole_map.py", "estimation/test_conditioning.py"),
    ),
    "team/estimation/joining.py": (10, (*JOIN, *CENTRE)),
    "team/estimation/joining_kernel.py": (10, JOIN),
    "team/estimation/gauss_newton.py": (14, JOIN),
    "team/estimation/submap_graph.py": (8, JOIN),
    "team/estimation/submap_factor.py": (6, (*JOIN, "estimation/test_sensitivity.py")),
    "team/estimation/marginals.py": (
        12,
        (
            *JOIN,
            "central/test_confirmed.py",
            "central/test_monitor.py",
            "central/test_join_rule.py",
        ),
    ),
    "team/estimation/merging.py": (8, JOIN),
    "team/estimation/alignment.py": (10, JOIN),
    "team/estimation/island_ties.py": (6, JOIN),
    "team/estimation/minima.py": (8, (*JOIN, "estimation/test_bends.py")),
    "team/estimation/sighting.py": (
        6,
        ("estimation/test_sightings.py", "stream/test_pose_grid.py"),
    ),
    "team/estimation/sighting_kernel.py": (6, ("estimation/test_sightings.py",)),
    "team/estimation/sparse.py": (6, ("estimation/test_sparse.py", "estimation/test_joining.py")),
    "team/estimation/sparse_kernel.py": (
        6,
        ("estimation/test_sparse.py", "estimation/test_big_panels.py"),
    ),
    "team/estimation/sparse_layout.py": (
        6,
        ("estimation/test_sparse.py", "estimation/test_joining.py"),
    ),
    "team/estimation/ordering.py": (5, ("estimation/test_sparse.py",)),
    "central/tick_fold.py": (12, CENTRE),
    "central/submap_set.py": (10, CENTRE),
    "central/join_rule.py": (14, CENTRE),
    "central/monitor.py": (12, ("central/test_monitor.py", "central/test_withdrawal.py")),
    "central/withdrawal.py": (8, ("central/test_withdrawal.py", "central/test_monitor.py")),
    "central/roll.py": (8, ("central/test_node.py", "central/test_withdrawal.py")),
    "central/node.py": (6, ("central/test_node.py", "central/test_withdrawal.py")),
}
