"""Class evidence of a window's landmarks, from their associated detections."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from teamslam.team import translate
from teamslam.team.config import UNNAMED
from teamslam.team.estimation.hybrid_slam.window import ClosedWindow
from teamslam.team.estimation.submap import Became
from teamslam.team.wire import messages as m


def classify_landmarks(
    closed: ClosedWindow, found: Became, measurements: Sequence[m.Measurement]
) -> ClosedWindow:
    """Sum ln P(reported class | class) of each unnamed landmark's detections, at a window's close.

    Detections of other numbers of classes are left out.
    """
    rows = {
        each.stamp_ns: translate.classes_of(each, len(each.ranges) // 8)
        for each in measurements
        if isinstance(each, m.Detections) and each.classes
    }
    if not rows:
        return closed
    most = max(row.shape[1] for row in rows.values())
    classes = np.zeros((len(closed.local.unnamed.counts), most))
    scans = np.repeat(found.stamps, found.counts).tolist()
    each_one = zip(scans, found.rows.tolist(), found.landmarks.tolist(), strict=True)
    for stamp_ns, row, landmark in each_one:
        own = rows.get(stamp_ns)
        if landmark >= UNNAMED and own is not None and own.shape[1] == most:
            classes[landmark - UNNAMED] += own[row]
    unnamed = replace(closed.local.unnamed, classes=classes)
    return replace(closed, local=replace(closed.local, unnamed=unnamed))
