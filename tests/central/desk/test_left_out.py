from dataclasses import replace

import numpy as np

from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.central.desk.left_out import is_kept, spans_left_out
from teamslam.central.desk.paths import smoothed_paths
from teamslam.central.desk.verification.recorded import Recorded
from teamslam.sim.in_memory.team import run_team
from teamslam.sim.scenarios.source import streams_of
from teamslam.team.wire import messages as m
from tests.central.test_diagnosis import TEAM, scenario
from tests.trials.stress_world import CarriedOff

S = 1_000_000_000


def jump(at_s: int, place: tuple[float, ...] = ()) -> m.Diagnosis:
    return m.Diagnosis(cause="carried_off", robot="r2", at_ns=at_s * S, place=place)


def test_both_windows_beside_a_jump_are_left_out_with_the_pose_between_them():
    ends = [s * S for s in range(10, 101, 10)]
    stamps = np.arange(0, 101, 5) * S
    spans = spans_left_out([jump(50)], "r2", ends)
    assert (stamps[~is_kept(stamps, spans)] // S).tolist() == [45, 50, 55]
    start = spans_left_out([jump(0)], "r2", ends)
    assert (stamps[~is_kept(stamps, start)] // S).tolist() == [0, 5]
    assert not spans_left_out([jump(50)], "r1", ends)
    assert not spans_left_out([jump(50, (1.0, 2.0))], "r2", ends), "the stream is cut there"


def test_the_path_has_no_poses_where_the_robot_was_carried_off(tmp_path):
    off = CarriedOff("r2", 4.0, 0.6, 45.0)
    of = scenario(replace(TEAM, carried_off=(off,)), tmp_path)
    samples = list(run_team(of, streams_of(of)))
    recorded = Recorded()
    for each in samples:
        recorded.take(each)
    run = evaluate(samples)
    path = smoothed_paths(recorded)["r2"]
    assert path.at_keyframes
    gap = int(np.diff(path.stamps_ns).argmax())
    begin, end = (path.stamps_ns[gap : gap + 2] * 1e-9).tolist()
    assert begin < off.at_s < end
    (note,) = (each for each in run.notes if "left out" in each)
    assert note.startswith(f"r2's path from {begin:.1f} s to {end:.1f} s is left out: ")
    truth = run.robots["r2"].truth
    at = np.searchsorted(truth.stamps_ns, path.stamps_ns).clip(0, len(truth.stamps_ns) - 1)
    away = path.poses[:, :2] - truth.poses[at, :2]
    assert np.hypot(*away.T).max() < 1.0
    assert run.robots["r2"].smoothed.errors[:, :2].max() < 0.5
