"""Data association: which detections are of one landmark, inside a window and between submaps.

Inside a window, from its own measurements alone: `scans` holds the detections, `tracking` filters
them (EKF), `smoothing` solves the window for a given association, `clustering` associates again and
merges, `certainty` gives the probability of each association.

Between submaps, on the joint Gaussian of a map's landmarks: `gating` evaluates pairs of landmarks,
`density` and `visibility` give the evidence against them, `joint_compatibility` accepts sets of
pairs, `island_view` runs the steps of a tick, `voting` and `closure` search for a patch of
landmarks elsewhere, and `verification` tests a closure. The results are `landmark_sets`, stored in
`member_log`. `teamslam.team.estimation.map_joining.fold_association` applies them to the graph.
"""
