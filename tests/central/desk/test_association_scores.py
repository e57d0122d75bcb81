from typing import Any

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from teamslam.central.desk.evaluation.association import association_result
from teamslam.central.desk.evaluation.evaluation import distances
from teamslam.central.desk.evaluation.figures import association_json
from teamslam.central.desk.evaluation.log import collect_log
from teamslam.central.desk.evaluation.matching import assign, gospa, half_spacing
from teamslam.team.config import UNNAMED
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Outgoing, Sample
from teamslam.team.wire.codec import encoded
from tests import build

NONE = m.NO_LABEL
TEN, UNKNOWN = 10**9, m.UNCONFIRMED


def sample(channel: ch.Channel, name: str, message: m.Message) -> Sample:
    return Sample(Outgoing(channel, name, message).key, encoded(message), message.stamp_ns, 1, 0)


def truth(robot: str, labels: list[int]) -> Sample:
    n = len(labels)
    scans = {"stamps": np.arange(n) * TEN, "counts": [1] * n, "labels": labels}
    return sample(ch.TRUTH_LABELS, robot, build.built(m.TruthLabels, robot=robot, **scans))


def window(robot: str, sequence: int, first: int, landmarks: list[int]) -> Sample:
    n = len(landmarks)
    message = build.built(
        m.Association,
        stamp_ns=(first + n) * TEN,
        robot=robot,
        sequence=sequence,
        stamps=(first + np.arange(n)) * TEN,
        counts=[1] * n,
        rows=[0] * n,
        landmarks=[UNNAMED + x if x >= 0 else UNKNOWN for x in landmarks],
    )
    return sample(ch.ASSOCIATION, robot, message)


def final(table: dict[str, list[tuple[int, int, int]]]) -> Sample:
    """By robot: (sequence, local, identity − 2³¹)."""
    memberships = tuple(
        build.built(
            m.Membership,
            robot=robot,
            sequences=[row[0] for row in rows],
            locals=[row[1] for row in rows],
            identities=[UNNAMED + row[2] for row in rows],
            steps=bytes(len(rows)),
            figures=np.zeros(3 * len(rows)),
        )
        for robot, rows in table.items()
    )
    message = build.fused_map(final=True, joint=False, means=b"", memberships=memberships)
    return sample(ch.FINAL_MAP, "", message)


def scores(samples: list[Sample]) -> dict[str, Any]:
    result = association_result(collect_log(samples))
    assert result is not None
    return association_json(result)


def test_a_run_without_an_error_is_scored_as_one():
    found = scores(
        [
            truth("r1", [7, 7, 8, 7, 8, NONE]),
            window("r1", 0, 0, [0, 0, 1]),
            window("r1", 1, 3, [0, 1, 1]),
            final({"r1": [(0, 0, 5), (0, 1, 6), (1, 0, 5), (1, 1, 6)]}),
        ]
    )
    assert (found["precision"], found["recall"], found["f1"]) == (1.0, 1.0, 1.0)
    assert (found["wrong_percent"], found["duplicates"], found["landmarks"]) == (0.0, 0, 2)
    assert found["unlabelled_detections_in_the_map"] == 1


def test_duplicates_wrong_members_and_what_is_left_out_are_counted():
    found = scores(
        [
            truth("r1", [7, 7, 8, 7, 7, 7]),
            window("r1", 0, 0, [0, 0, 0]),
            window("r1", 1, 3, [0, 0, -1]),
            final({"r1": [(0, 0, 5), (1, 0, 6)]}),
        ]
    )
    assert found["duplicates"] == 1
    assert found["duplicates_confirmed"] == 0
    assert found["labelled_detections_left_out"] == 1
    assert found["wrong_percent"] == pytest.approx(100.0 / 6.0)
    assert found["precision"] == pytest.approx(2.0 / 4.0)  # 1 + 1 of 3 + 1 pairs are right
    assert found["recall"] == pytest.approx(2.0 / 10.0)  # of all pairs of five equal labels
    assert found["windows"]["recall"] == pytest.approx(2.0 / 4.0)


@pytest.mark.parametrize(("label", "right", "wrong"), [(7, 1, 0), (9, 0, 1)])
def test_a_merge_of_robots_is_judged_by_the_landmarks_that_they_share(label, right, wrong):
    found = scores(
        [
            truth("r1", [7, 7]),
            truth("r2", [label, label]),
            window("r1", 0, 0, [0, 0]),
            window("r2", 0, 0, [0, 0]),
            final({"r1": [(0, 0, 5)], "r2": [(0, 0, 5)]}),
        ]
    )
    assert (found["merges_right"], found["merges_wrong"]) == (right, wrong)


def test_a_run_without_labels_has_no_scores():
    assert association_result(collect_log([window("r1", 0, 0, [0])])) is None


def test_a_path_fits_a_gps_of_another_frame_with_a_lever_and_some_fixes_that_are_wrong():
    rng = np.random.default_rng(0)
    headings = np.cumsum(rng.normal(size=200) * 0.2)
    steps = np.column_stack((np.cos(headings), np.sin(headings)))
    poses = np.column_stack((np.cumsum(steps, axis=0), headings))
    c, s = np.cos(headings), np.sin(headings)
    antenna = poses[:, :2] + np.column_stack((3.0 * c - 0.5 * s, 3.0 * s + 0.5 * c))
    turned = antenna @ np.array([[0.6, 0.8], [-0.8, 0.6]]) + [5.0, -7.0]
    turned[::10] += rng.normal(size=(20, 2)) * 20.0
    assert np.median(distances(poses, turned)) < 1e-2
    assert np.median(distances(1.1 * poses, turned)) > 0.1, "no scale is fitted"


TRUE = np.array([[0.0, 0.0], [4.0, 0.0], [0.0, 4.0]])


def test_each_missed_and_each_false_landmark_costs_half_the_square_of_the_cut_off():
    equal = gospa(TRUE[::-1], TRUE, 2.0)
    assert (equal.distance_m, equal.missed, equal.false) == (0.0, 0, 0)
    found = gospa(np.array([[0.3, 0.0], [9.0, 9.0]]), TRUE, 2.0)
    assert found.distance_m == pytest.approx(np.sqrt(0.09 + 0.5 * 4.0 * 3))
    assert (found.missed, found.false) == (2, 1)
    assert found.localisation_m == pytest.approx(0.3)
    duplicate = gospa(np.concatenate((TRUE, TRUE[:1] + 0.1)), TRUE, 2.0)
    assert (duplicate.missed, duplicate.false) == (0, 1)


def test_the_cut_off_is_half_of_the_spacing():
    assert half_spacing(TRUE) == 2.0
    assert half_spacing(TRUE[:1]) is None


def test_points_are_assigned_with_the_least_sum_of_squared_distances():
    rng = np.random.default_rng(0)
    for n, k in ((0, 3), (1, 1), (4, 7), (7, 4), (12, 12)):
        found, true = rng.uniform(0.0, 3.0, (n, 2)), rng.uniform(0.0, 3.0, (k, 2))
        rows, columns, squared = assign(found, true, 1.0)
        costs = np.minimum(((found[:, None] - true[None]) ** 2).sum(axis=2), 1.0)
        best = costs[linear_sum_assignment(costs)].sum()
        assert len({*rows.tolist()}) == len({*columns.tolist()}) == len(squared)
        assert squared.sum() + min(n, k) - len(squared) == pytest.approx(best)
