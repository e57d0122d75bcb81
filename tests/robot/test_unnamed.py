import numpy as np
import pytest

from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.central.desk.verification.verification import verify
from teamslam.sim.in_memory.team import run_team
from teamslam.sim.scenarios.scenario import load, with_options
from teamslam.sim.scenarios.source import streams_of
from teamslam.sim.world.streams import NO_LABEL
from teamslam.team import translate
from teamslam.team.config import UNNAMED
from teamslam.team.driver import measurement_messages
from teamslam.team.driver.measurement_messages import MeasurementError
from teamslam.team.rejection import Rejection
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.arrays import ids, octets, stamps
from teamslam.team.wire.bus import opened
from tests.scenarios import with_world
from tests.sim.reruns import written

STEPS = 50


def hidden(**world):
    scenario = with_options(load("thesis-b"), seed=3, robots=1, identities="hidden")
    return with_world(scenario, steps=STEPS, **world)


@pytest.fixture(scope="module")
def run():
    scenario = hidden(clutter=0.2, missed=0.1, tagged=0.4)
    streams = streams_of(scenario)
    return streams, list(run_team(scenario, streams))


def of(samples, channel):
    return [message for c, _, message in map(opened, samples) if c is channel]


def test_detections_are_told_without_identities_and_the_labels_only_to_the_evaluator(run):
    _streams, samples = run
    seen = of(samples, ch.OBSERVATIONS)
    detections = [x for x in seen if isinstance(x, m.Detections)]
    named = [x for x in seen if isinstance(x, m.Observations)]
    assert detections
    assert named
    (labels,) = of(samples, ch.TRUTH_LABELS)
    assert stamps(labels.stamps, "stamps").tolist() == [x.stamp_ns for x in detections]
    counts = [len(x.ranges) // 8 for x in detections]
    assert ids(labels.counts, "counts").tolist() == counts
    told = set(ids(labels.labels, "labels").tolist())
    assert m.NO_LABEL in told
    assert not told & set(np.concatenate([ids(x.ids, "ids") for x in named]).tolist())


def test_each_measurement_is_used_once_and_what_nobody_confirms_is_named(run):
    _, samples = run
    used = evaluate(samples).robots["r1"].consumption
    assert used.each_once
    reasons = {Rejection.UNCONFIRMED.disposition, Rejection.CLUTTER.disposition}
    assert sum(used.ledger.values()) == used.published
    assert set(used.ledger) <= reasons | {"in a submap", "start pose"}


def test_a_submap_says_of_its_unnamed_landmarks_what_the_detections_say(run):
    _, samples = run
    became = {x.sequence: x for x in of(samples, ch.ASSOCIATION)}
    submaps = of(samples, ch.SUBMAP)
    assert len(submaps) == len(became) > 3
    for submap in submaps:
        numbers = ids(submap.ids, "ids")
        unnamed = numbers[numbers >= UNNAMED]
        landmarks = ids(became[submap.sequence].landmarks, "landmarks")
        taken, counts = np.unique(landmarks[landmarks >= UNNAMED], return_counts=True)
        assert (taken == unnamed).all()
        assert (counts == ids(submap.counts, "counts")).all()
        rows = octets(submap.seen, "seen").reshape(len(unnamed), -1)
        seen = np.unpackbits(rows, axis=1, count=submap.keyframes, bitorder="little")
        assert (seen.sum(axis=1) == counts).all()
        assert submap.gated == (landmarks < UNNAMED).sum()


def test_inside_windows_nearly_every_pair_is_right(run):
    _, samples = run
    (labels,) = of(samples, ch.TRUTH_LABELS)
    bounds = np.cumsum([0, *ids(labels.counts, "counts")])
    label_of = {
        (stamp, row): label
        for k, stamp in enumerate(stamps(labels.stamps, "stamps").tolist())
        for row, label in enumerate(ids(labels.labels, "labels")[bounds[k] : bounds[k + 1]])
    }
    wrong = used = 0
    for each in of(samples, ch.ASSOCIATION):
        scans = np.repeat(stamps(each.stamps, "stamps"), ids(each.counts, "counts"))
        rows = zip(scans.tolist(), ids(each.rows, "rows").tolist(), strict=True)
        own = np.array([label_of[place] for place in rows])
        landmarks = ids(each.landmarks, "landmarks")
        for landmark in np.unique(landmarks[landmarks >= UNNAMED]):
            members = own[landmarks == landmark]
            _, counts = np.unique(members, return_counts=True)
            used, wrong = used + len(members), wrong + len(members) - counts.max()
    assert used > 30
    assert wrong <= 0.02 * used


def test_a_log_with_hidden_identities_is_computed_again_to_the_same_bytes(run, tmp_path):
    _, samples = run
    result = verify(written(tmp_path / "log.mcap", samples))
    assert result.first is None
    checked = {each.channel: each for each in result.channels}
    assert checked["association"].equal == checked["association"].messages > 3


TREES = np.array([[3.0, 1.0], [5.0, -2.0], [8.0, 2.0], [11.0, -1.0]])


def test_a_driver_gives_probabilities_and_a_wrong_shape_is_named():
    given = [[0.9, 0.1], [0.2, 0.8]]
    call = measurement_messages.Call("r1", 0, "detect")
    seen = measurement_messages.detections(call, ([1.0, 2.0], [0.0, 0.1]), None, given)
    assert np.allclose(np.exp(translate.classes_of(seen, 2)), given)
    with pytest.raises(MeasurementError, match="one row for each of 2"):
        measurement_messages.detections(call, ([1.0, 2.0], [0.0, 0.1]), None, given[:1])


def test_a_submaps_landmark_has_the_sum_of_its_detections(tmp_path):
    kinds = [0, 1, 1, 0]
    robot = tmp_path / "set" / "r1"
    robot.mkdir(parents=True)
    times = np.arange(0, 21) * 0.5
    odometry = [f"{t},0.2,0.0" for t in times]
    (robot / "odometry.csv").write_text("\n".join(["t_s,forward_m_s,yaw_rate_rad_s", *odometry]))
    rows = []
    for t in times[1:-1]:
        for (x, y), kind in zip(TREES - [0.2 * t, 0.0], kinds, strict=True):
            rows.append(f"{t},{np.hypot(x, y)},{np.arctan2(y, x)},{kind}")
    (robot / "detections.csv").write_text("\n".join(["t_s,range_m,bearing_rad,class", *rows]))
    scenario = with_options(load("recorded"), dataset=tmp_path / "set")
    streams = streams_of(scenario)
    assert set(streams.streams[0].landmark_detections.ids.tolist()) == {NO_LABEL}
    submaps = [
        message
        for sample in run_team(scenario, streams)
        if isinstance(message := opened(sample)[2], m.Submap) and message.counts
    ]
    local = translate.local_map_of(submaps[0])
    assert len(local.ids) == len(TREES)
    near = np.argmin(np.linalg.norm(local.landmarks[:, None] - TREES, axis=2), axis=1)
    expected = np.log([[0.95, 0.05], [0.05, 0.95]])[[kinds[k] for k in near]]
    assert np.allclose(local.unnamed.classes, local.unnamed.counts[:, None] * expected)
