"""The product's path: for each module how many of its mutants are drawn, and who should notice.

The tests are files under tests/. The comparison methods of `sim/studies` are not in it.
"""

CENTRE = (
    "central/test_map_publisher.py",
    "central/test_node.py",
    "central/test_tick_fold.py",
    "test_store.py",
    "central/test_withdrawal.py",
    "central/test_confirmed.py",
)
JOIN = (
    "estimation/map_joining/test_joining.py",
    "estimation/map_joining/test_annealing.py",
    "estimation/map_joining/test_damping.py",
    "estimation/map_joining/test_landmark_weights.py",
    "estimation/map_joining/test_sightings.py",
    "estimation/map_joining/test_alignment.py",
    "estimation/map_joining/test_minima.py",
)
WINDOW = ("estimation/hybrid_slam/test_window.py", "estimation/hybrid_slam/test_pose_nodes.py")
GENERAL = (
    "estimation/hybrid_slam/test_landmark_kernel.py",
    "estimation/hybrid_slam/test_general_measurements.py",
    "estimation/hybrid_slam/test_mount.py",
)
PIPELINE = (
    "robot/test_hybrid.py",
    "estimation/hybrid_slam/test_pose_grid.py",
    "estimation/hybrid_slam/test_outliers.py",
)

MODULES: dict[str, tuple[int, tuple[str, ...]]] = {
    "team/estimation/hybrid_slam/window.py": (
        12,
        (
            *WINDOW,
            "estimation/hybrid_slam/test_correlated_measurements.py",
            "estimation/hybrid_slam/test_depletion.py",
            *GENERAL,
        ),
    ),
    "team/estimation/hybrid_slam/window_kernel.py": (
        8,
        (*WINDOW, "estimation/hybrid_slam/test_innovation.py", *GENERAL),
    ),
    "team/estimation/hybrid_slam/moments.py": (6, WINDOW),
    "team/estimation/hybrid_slam/arrow_kernel.py": (
        6,
        ("estimation/hybrid_slam/test_sensitivity.py",),
    ),
    "team/estimation/hybrid_slam/landmarks_along_paths.py": (
        8,
        (*WINDOW, "estimation/hybrid_slam/test_correlated_measurements.py"),
    ),
    "team/estimation/hybrid_slam/pipeline.py": (10, PIPELINE),
    "team/estimation/hybrid_slam/open_window.py": (8, PIPELINE),
    "team/estimation/hybrid_slam/fastslam.py": (
        8,
        ("estimation/hybrid_slam/test_fastslam.py", *WINDOW),
    ),
    "team/estimation/hybrid_slam/fastslam_kernel.py": (
        8,
        ("estimation/hybrid_slam/test_fastslam.py",),
    ),
    "team/estimation/hybrid_slam/blocks.py": (
        8,
        ("estimation/hybrid_slam/test_fastslam.py", "estimation/test_scans.py", *GENERAL),
    ),
    "team/estimation/hybrid_slam/landmark_kernel.py": (
        8,
        ("estimation/hybrid_slam/test_fastslam.py", *GENERAL),
    ),
    "team/estimation/hybrid_slam/innovation_kernel.py": (
        6,
        ("estimation/hybrid_slam/test_innovation.py",),
    ),
    "team/estimation/models.py": (8, ("estimation/test_models.py",)),
    "team/estimation/geometry.py": (6, ("estimation/test_geometry.py",)),
    "team/estimation/hybrid_slam/sensitivity_kernel.py": (
        8,
        ("estimation/hybrid_slam/test_sensitivity.py",),
    ),
    "team/estimation/hybrid_slam/redrawing.py": (
        8,
        ("estimation/hybrid_slam/test_redrawing.py",),
    ),
    "team/estimation/map_joining/chain_kernel.py": (
        8,
        ("estimation/map_joining/test_conditioning.py", "robot/test_team_map.py"),
    ),
    "team/estimation/hybrid_slam/consensus.py": (
        12,
        ("estimation/hybrid_slam/test_consensus.py", "estimation/hybrid_slam/test_outliers.py"),
    ),
    "team/estimation/hybrid_slam/consensus_kernel.py": (
        10,
        ("estimation/hybrid_slam/test_consensus.py", *GENERAL),
    ),
    "team/estimation/map_joining/conditioning.py": (
        6,
        ("estimation/map_joining/test_conditioning.py", "robot/test_team_map.py"),
    ),
    "team/estimation/map_joining/whole_map.py": (
        10,
        ("estimation/map_joining/test_whole_map.py", "estimation/map_joining/test_conditioning.py"),
    ),
    "team/estimation/map_joining/tie_kernel.py": (
        8,
        ("estimation/map_joining/test_whole_map.py", "estimation/map_joining/test_conditioning.py"),
    ),
    "team/estimation/map_joining/joining.py": (10, (*JOIN, *CENTRE)),
    "team/estimation/map_joining/joining_kernel.py": (
        10,
        (*JOIN, "estimation/map_joining/test_range_scale.py"),
    ),
    "team/estimation/map_joining/gauss_newton.py": (14, JOIN),
    "team/estimation/map_joining/submap_graph.py": (8, JOIN),
    "team/estimation/map_joining/submap_factor.py": (
        6,
        (*JOIN, "estimation/hybrid_slam/test_sensitivity.py"),
    ),
    "team/estimation/map_joining/marginals.py": (
        12,
        (
            *JOIN,
            "central/test_confirmed.py",
            "central/test_monitor.py",
            "central/test_map_publisher.py",
        ),
    ),
    "team/estimation/map_joining/merging.py": (8, JOIN),
    "team/estimation/map_joining/alignment.py": (10, JOIN),
    "team/estimation/map_joining/island_ties.py": (6, JOIN),
    "team/estimation/map_joining/minima.py": (
        8,
        (*JOIN, "estimation/map_joining/test_nonlinearity.py"),
    ),
    "team/estimation/inter_robot.py": (
        6,
        ("estimation/map_joining/test_sightings.py", "estimation/hybrid_slam/test_pose_grid.py"),
    ),
    "team/estimation/map_joining/inter_robot_kernel.py": (
        6,
        ("estimation/map_joining/test_sightings.py",),
    ),
    "team/estimation/sparse_cholesky/sparse.py": (
        6,
        ("estimation/sparse_cholesky/test_sparse.py", "estimation/map_joining/test_joining.py"),
    ),
    "team/estimation/sparse_cholesky/sparse_kernel.py": (
        6,
        (
            "estimation/sparse_cholesky/test_sparse.py",
            "estimation/sparse_cholesky/test_big_panels.py",
        ),
    ),
    "team/estimation/sparse_cholesky/sparse_layout.py": (
        6,
        ("estimation/sparse_cholesky/test_sparse.py", "estimation/map_joining/test_joining.py"),
    ),
    "team/estimation/sparse_cholesky/ordering.py": (
        5,
        ("estimation/sparse_cholesky/test_sparse.py",),
    ),
    "central/tick_fold.py": (8, CENTRE),
    "central/checkpoints.py": (4, CENTRE),
    "central/fold_inputs.py": (6, CENTRE),
    "team/store.py": (18, CENTRE),
    "central/submap_fold.py": (14, CENTRE),
    "central/join_messages.py": (8, CENTRE),
    "central/map_publisher.py": (12, CENTRE),
    "central/sent_priors.py": (10, ("central/test_sent_priors.py",)),
    "team/estimation/chi2_kernel.py": (8, ("estimation/test_consistency.py",)),
    "team/estimation/map_joining/join_kernel.py": (
        8,
        ("estimation/map_joining/test_whole_map.py", "estimation/map_joining/test_conditioning.py"),
    ),
    "team/estimation/consistency.py": (
        6,
        ("estimation/test_consistency.py", "central/test_monitor.py"),
    ),
    "central/monitor.py": (12, ("central/test_monitor.py", "central/test_withdrawal.py")),
    "central/withdrawal.py": (8, ("central/test_withdrawal.py", "central/test_monitor.py")),
    "central/attendance.py": (8, ("central/test_node.py", "central/test_withdrawal.py")),
    "central/node.py": (6, ("central/test_node.py", "central/test_withdrawal.py")),
}
