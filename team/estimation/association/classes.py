"""Evidence of two landmarks' classes that they are one.

A landmark has ln P(reports | class c) for each of C classes, up to a constant: the sum of its
detections' rows. With p(c) ∝ P(reports | c) for equally frequent classes, the log-likelihood ratio
of one landmark against two is ln(C Σ_c p₁(c) p₂(c)).
"""

from collections.abc import Sequence

import numpy as np

from teamslam.team import core
from teamslam.team.shapes import Float

Classes = Float[np.ndarray, "_ _"]  # A row for each landmark, a column for each class
CONTRADICTED = 3.0
"""Log-likelihood ratio (1 in 20) against one landmark from which a pair is not associated."""


def compare_classes(one: Classes, two: Classes) -> Float[np.ndarray, " n"]:
    """Compute the log-likelihood ratio of one landmark against two, row by row."""
    p, q = (core.exp(each - each.max(axis=1, keepdims=True)) for each in (one, two))
    common = (p * q).sum(axis=1) / (p.sum(axis=1) * q.sum(axis=1))
    return np.asarray(core.log(common * one.shape[1]))


def stack_classes(parts: Sequence[tuple[int, Classes | None]]) -> Classes | None:
    """Concatenate rows of classes, given with their counts; None if no list has classes.

    A landmark without classes has zeros; an unreported class is as unlikely as the least likely
    one.
    """
    most = max((rows.shape[1] for _, rows in parts if rows is not None), default=0)
    if not most:
        return None
    out = []
    for count, rows in parts:
        if rows is None or not rows.shape[1]:
            out.append(np.zeros((count, most)))
        else:
            least = rows.min(axis=1, keepdims=True)
            out.append(np.hstack((rows, np.repeat(least, most - rows.shape[1], axis=1))))
    return np.concatenate(out)
