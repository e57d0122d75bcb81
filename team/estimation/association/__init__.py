"""Data association: which detections are of one landmark, inside a window and between submaps.

Inside a window: `scans`, `tracking` (EKF), `smoothing`, `clustering`, `certainty`. Between submaps,
on the joint Gaussian of a map's landmarks: `gating` of pairs, `density` and `visibility` as
evidence against them, `joint_compatibility` of sets of pairs, `island_view` with the steps of a
tick, `voting` and `closure`, `verification`. The results are `landmark_sets`, stored in
`member_log` and applied by `teamslam.team.estimation.map_joining.fold_association`.
"""
