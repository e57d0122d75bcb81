"""Data association: which detections are of one landmark, in a window and between submaps.

In a window: `scans`, `tracking`, `smoothing`, `clustering`. Between submaps: `gating`
of pairs, `visibility` as evidence, `joint_compatibility` of sets of pairs, `island_view` with the
steps of a tick, `voting`, `closure`, `verification`; the results are `landmark_sets`, stored in
`member_log`.
"""
