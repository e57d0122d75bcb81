import os
import random
import signal
import struct
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
from click.testing import CliRunner

from teamslam.central.desk.verification import verification
from teamslam.central.desk.verification.recorded import RerunError
from teamslam.central.desk.verification.verification import Verification, verify
from teamslam.sim.cli.rerun import app
from teamslam.sim.cli.results import print_changes, print_placements
from teamslam.sim.in_memory.team import final_map
from teamslam.sim.recorded.changed_run import Changes, changed_run
from teamslam.sim.scenarios.document import ScenarioError
from teamslam.team import translate
from teamslam.team.pairs import PAIRS
from teamslam.team.recording.reader import open_log
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.arrays import derivatives, floats, from_derivatives, from_floats
from teamslam.team.wire.bus import Sample
from teamslam.team.wire.codec import encoded
from tests import build
from tests.sim.reruns import changed, messages, said, team_samples, thesis, written
from tests.support import example
from tests.teams import LOCALISERS, Team, config, stream, world_of

STEPS = 60
ODOMETRY_OF_SUBMAP_3 = 35  # the 35th interval of r2 lies in its fourth window of 10 s


@pytest.fixture(scope="module")
def samples(tmp_path_factory):
    """A run with measurements second by second, so that maps return while robots drive."""
    hurried = written(tmp_path_factory.mktemp("log") / "log.mcap", team_samples(thesis(STEPS)))
    return changed_run(hurried, Changes())


@pytest.fixture(scope="module")
def log(samples, tmp_path_factory):
    return written(tmp_path_factory.mktemp("log") / "log.mcap", samples)


def counts(result: Verification) -> dict[str, tuple[int, int]]:
    return {c.channel: (c.messages, c.equal) for c in result.channels}


def all_equal(result: Verification) -> bool:
    assert result.first is None, str(result.first)
    return all(c.equal == c.messages for c in result.channels) and result.other_platform == ()


def with_one_bit(message: m.Message) -> m.Message:
    (bits,) = struct.unpack("<q", struct.pack("<d", message.forward))
    (other,) = struct.unpack("<d", struct.pack("<q", bits ^ 1))
    return msgspec.structs.replace(message, forward=other)


def flipped(samples: list[Sample]) -> list[Sample]:
    counter = messages(samples, ch.ODOMETRY, "r2")[ODOMETRY_OF_SUBMAP_3].number

    def change(message: m.Message) -> m.Message:
        hit = (message.robot, message.number) == ("r2", counter)
        return with_one_bit(message) if hit else message

    return changed(samples, ch.ODOMETRY, change)


def test_every_recomputable_message_of_a_run_comes_out_again(log):
    result = verify(log)
    assert all_equal(result)
    silent = {ch.SIGHTING_FACTOR.name, ch.CENTRAL_POSE.name, ch.ASSOCIATION.name}
    recomputable = {
        c.name for c in ch.CHANNELS if c.recomputable and not c.name.startswith("team_")
    } | {ch.TEAM_POSE.name}  # the others are messages between peers
    assert counts(result).keys() == recomputable - silent
    assert counts(result)["submap"] == (12, 12)
    assert verify(log, processes=2) == result


@pytest.mark.parametrize(("estimator", "fusion"), sorted(PAIRS))
def test_every_pair_ends_with_a_map_of_finite_values_and_comes_out_again(
    estimator, fusion, tmp_path
):
    samples = team_samples(thesis(30, estimator=estimator, fusion=fusion))
    fused = final_map(samples)
    ids, means = translate.landmarks_of(fused)
    assert fused.final
    assert (len(ids) > 10) == (fusion != "alone")
    assert bool(fused.reasons) == (fusion in ("kalman", "kalman-per-axis", "alone"))
    assert np.isfinite(means).all()
    assert (np.diag(translate.landmark_covariance_of(fused)) > 0.0).all()
    ended = {r: messages(samples, ch.ROBOT_DONE, r)[0] for r in ("r1", "r2")}
    for done in ended.values():
        assert sum(each.measurements for each in done.ledger) == done.measurements
    (end,) = messages(samples, ch.END)
    assert {s.robot: s.measurements for s in end.streams} == {
        robot: done.measurements for robot, done in ended.items()
    }
    result = verify(written(tmp_path / "log.mcap", samples))
    assert all_equal(result)
    assert counts(result)["own_pose"][0] >= 30
    if fusion != "alone":
        assert counts(result)["fused_map"][0] >= 2
    if estimator not in (*LOCALISERS, "hybrid"):
        assert counts(result)["own_map"][0] >= 4


def shifted(samples: list[Sample], channel: ch.Channel, victim: m.Message) -> list[Sample]:
    def change(message: m.Message) -> m.Message:
        if message != victim:
            return message
        means = floats(message.means, "means").copy()
        means[3] += 0.25
        return msgspec.structs.replace(message, means=from_floats(means))

    return changed(samples, channel, change)


@pytest.mark.parametrize("fusion", ["latest", "alone"])
def test_a_tampered_own_map_is_found_and_so_is_what_was_made_of_it(fusion, tmp_path):
    samples = team_samples(thesis(30, estimator="ekf-slam", fusion=fusion))
    tampered = shifted(samples, ch.OWN_MAP, messages(samples, ch.OWN_MAP, "r2")[-1])
    result = verify(written(tmp_path / "log.mcap", tampered))
    found = {c.channel: c.different for c in result.channels if c.different}
    assert found == {"own_map": 1, "final_map": 1}


def test_a_flipped_bit_of_one_odometry_measurement_is_traced_to_its_submap(samples, tmp_path):
    result = verify(written(tmp_path / "log.mcap", flipped(samples)))
    first = result.first
    assert (first.key, first.counter) == ("robot/r2/submap", 3)
    assert first.field.startswith("mean[")
    assert counts(result)["submap"] == (12, 11), "no other submap depends on that measurement"
    for name in ("fused_map", "prior", "final_map", "trajectory"):
        assert counts(result)[name][0] == counts(result)[name][1], "maps follow from submaps"


def test_a_tampered_derivative_of_a_submap_is_named(samples, tmp_path):
    victim = messages(samples, ch.SUBMAP, "r2")[1]
    count = len(victim.biases) * len(victim.mean) // 8
    other = derivatives(victim.sensitivity, count, "sensitivity")
    other[5] += 1.0
    tampered = msgspec.structs.replace(victim, sensitivity=from_derivatives(other))
    log = written(
        tmp_path / "log.mcap",
        changed(samples, ch.SUBMAP, lambda each: tampered if each == victim else each),
    )
    first = verify(log).first
    assert (first.key, first.field) == ("robot/r2/submap", "sensitivity[5]")
    assert float(first.recorded) == pytest.approx(float(first.recomputed) + 1.0)


def test_a_tampered_map_is_the_only_one_that_differs(samples, tmp_path):
    tampered = shifted(samples, ch.FUSED_MAP, messages(samples, ch.FUSED_MAP)[1])
    result = verify(written(tmp_path / "log.mcap", tampered))
    assert sum(c.different for c in result.channels) == 1
    assert (result.first.key, result.first.field) == ("central/map", "means[3]")
    recorded, recomputed = float(result.first.recorded), float(result.first.recomputed)
    assert recorded == pytest.approx(recomputed + 0.25)


def test_a_missing_measurement_is_named_and_the_windows_behind_it_come_out(samples, tmp_path):
    lost = messages(samples, ch.ODOMETRY, "r2")[ODOMETRY_OF_SUBMAP_3]
    cut = changed(samples, ch.ODOMETRY, lambda x: None if x == lost else x)
    result = verify(written(tmp_path / "log.mcap", cut))
    assert counts(result)["submap"] == (12, 11)
    assert f"measurement {lost.number} is not in the log" in result.first.recomputed
    assert result.first.lacks
    assert {c.channel: c.lacking for c in result.channels if c.lacking}["submap"] == 1
    assert [c.channel for c in result.channels if c.different] == []


def test_what_was_made_of_a_map_that_is_lost_can_not_be_judged_and_all_else_is_equal(
    samples, tmp_path
):
    (lost, *_) = messages(samples, ch.PRIOR, "r2")
    poses = [x for x in messages(samples, ch.TEAM_POSE, "r2") if x.map_digest == lost.digest]
    assert poses
    cut = changed(samples, ch.PRIOR, lambda x: None if x == lost else x)
    result = verify(written(tmp_path / "log.mcap", cut))
    assert {c.channel: c.lacking for c in result.channels if c.lacking} == {"team_pose": len(poses)}
    assert [c.channel for c in result.channels if c.different] == []
    assert result.first is not None
    assert f"no prior {lost.digest.hex()} in the log" in str(result.first)


def test_on_another_platform_numbers_are_compared_within_a_tolerance(samples, tmp_path):
    def moved(by: float) -> list[Sample]:
        return changed(
            samples,
            ch.FINAL_MAP,
            lambda x: msgspec.structs.replace(x, means=from_floats(floats(x.means, "means") + by)),
        )

    other = {"core": "that of another day"}
    near = verify(written(tmp_path / "near.mcap", moved(1e-8), other))
    assert near.other_platform == ("core",)
    assert near.first is None
    assert [c.close for c in near.channels if c.channel == "final_map"] == [1]
    far = verify(written(tmp_path / "far.mcap", moved(1e-3), other))
    assert far.first.key == "central/final"
    here = verify(written(tmp_path / "here.mcap", moved(1e-8)))
    assert here.first is not None, "on the same platform one bit is a difference"


def restless(seed: int, *, cache: int | None = None, dies: bool = False) -> Team:
    """Two robots in any order of delivery; r1 is killed, and restarts or not.

    cache: number of measurements that its source still has; with too few a new incarnation begins.
    """
    robots = [stream("r1", 40), stream("r2", 40, y=1.0)]
    team = Team(world_of(*robots), [config("r1"), config("r2")], random.Random(seed))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("teamslam.sim.publisher.node.BATCH", 4)  # the world has not ended yet
        while len(team.sent[ch.SUBMAP.key("r1")]) < 3:
            assert team.step()
        team.kill("r1", patience=not dies)
        if not dies:
            team.resume(config("r1"))
            team.world.cache = cache
            first = team.robots["r1"].next_measurement
            team.world.measurements(encoded(build.measurements_request(incarnation=0, first=first)))
            team.world.cache = None
        team.run()
    return team


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("cache", [None, 0], ids=["a restart", "a new incarnation"])
def test_a_log_with_another_life_of_a_robot_comes_out_again(seed, cache, tmp_path):
    team = restless(seed, cache=cache)
    assert len(team.sent[ch.ROBOT_CONFIG.key("r1")]) == 2, "there were two lives"
    incarnations = {1} if cache is None else {1, 2}
    assert {s.incarnation for s in team.sent[ch.SUBMAP.key("r1")]} == incarnations
    assert all_equal(verify(written(tmp_path / "log.mcap", said(team))))


@pytest.mark.parametrize("processes", [1, 2])
def test_a_log_without_a_configuration_can_not_be_computed(processes, samples, tmp_path):
    bare = [
        s for s in samples if s.key != ch.ROBOT_CONFIG.key("robot/r1") and "config" not in s.key
    ]
    with pytest.raises(RerunError, match="no configuration of robot/r1"):
        verify(written(tmp_path / "log.mcap", bare), processes)


def test_a_killed_process_of_a_verification_is_an_error_with_its_remedy(log, monkeypatch):
    def die(*_):
        os.kill(os.getpid(), signal.SIGKILL)

    monkeypatch.setattr(verification, "recompute_centre", die)
    with pytest.raises(RerunError, match=r"was killed, .*: on one processor"):
        verify(log, processes=2)


def test_the_command_ends_with_1_on_a_difference_and_2_on_wrong_use(log, samples, tmp_path):
    runner = CliRunner()
    good = runner.invoke(app, ["rerun", str(log.path), "--verify"])
    assert good.exit_code == 0, good.output
    assert "all equal" in good.output
    bad = written(tmp_path / "bad.mcap", flipped(samples))
    result = runner.invoke(app, ["rerun", str(bad.path), "--verify"])
    assert result.exit_code == 1
    assert "robot/r2/submap" in result.output
    channels = ((sample, ch.channel_of(sample.key)) for sample in samples)
    sensors = [sample for sample, of in channels if of is not None and not of[0].recomputable]
    empty = runner.invoke(
        app, ["rerun", str(written(tmp_path / "e.mcap", sensors).path), "--verify"]
    )
    assert empty.exit_code == 1
    assert "nothing is verified" in empty.output
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(log.path.read_bytes()[:-40])
    result = runner.invoke(app, ["rerun", str(cut)])
    assert result.exit_code == 1
    assert "final map: the same bytes" in result.output
    assert "is cut, so the result is of the part before the cut" in " ".join(result.output.split())
    for wrong in (
        ["--verify", "--delay", "3"],
        ["--loss", "1"],
        ["--no-centre", "9-3"],
        ["--noise", "luck=2"],
        ["--noise", "range=0"],
        ["--noise", "range=2", "--noise", "range=3"],
    ):
        assert runner.invoke(app, ["rerun", str(log.path), *wrong]).exit_code == 2


def test_a_recomputed_run_is_written_as_a_log_that_verifies_with_its_report(log, tmp_path):
    out = tmp_path / "out"
    words = ["rerun", str(log.path), "--without", "r2", "-o", str(out)]
    for _ in range(2):
        assert CliRunner().invoke(app, words).exit_code == 0
    assert {"log.mcap", "log.mcap.1", "report.html", "maps.png"} <= {x.name for x in out.iterdir()}
    found = open_log(out / "log.mcap")
    assert all_equal(verify(found))
    assert {ch.SUBMAP.owner(s.key) for s in found.samples((ch.SUBMAP,))} == {"r1"}
    assert 'id="latency"' not in (out / "report.html").read_text(), "nothing was on its way"


# Under other conditions.


def final(samples: list[Sample]) -> bytes:
    (payload,) = [s.payload for s in samples if s.key == ch.FINAL_MAP.key()]
    return payload


def test_without_a_robot_the_map_is_that_of_a_team_that_never_had_it(log, samples):
    run = changed_run(log, Changes(without=("r2",)))
    assert messages(run, ch.SUBMAP, "r1") == messages(samples, ch.SUBMAP, "r1")
    alone = team_samples(thesis(STEPS, robots=1))  # without sightings: fewer measurements
    (one,), (other,) = (messages(each, ch.FINAL_MAP) for each in (run, alone))
    assert (one.means, one.covariance) == (other.means, other.covariance)
    assert one.members == other.members == build.version(r1=STEPS // 10 - 1)


def test_another_rule_is_the_run_that_would_have_used_it(log):
    other = team_samples(thesis(STEPS, fusion="kalman"))
    assert final(changed_run(log, Changes(fusion="kalman"))) == final(other)


@pytest.mark.parametrize(
    "changes",
    [
        Changes(seed=7),
        Changes(particles=20),
        Changes(window_s=20.0),
        Changes(noise=(("odometry", 2.0),)),
        Changes(noise=(("range", 0.5), ("bearing", 0.5))),
    ],
    ids=str,
)
def test_another_estimator_sees_the_same_measurements_and_gives_another_map(changes, log, samples):
    run = changed_run(log, changes)
    assert messages(run, ch.ODOMETRY, "r1") == messages(samples, ch.ODOMETRY, "r1")
    assert final(run) != final(samples)
    assert final(run) == final(changed_run(log, changes))


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        (Changes(without=("r9",)), "no robot r9"),
        (Changes(without=("r1", "r2")), "without robots"),
        (Changes(fusion="kalman", delay_s=1.0), "lockstep"),
        (Changes(fusion="latest", delay_s=1.0), "the rule latest is for comparison"),
        (Changes(estimator="hybrid-thesis"), "can not feed"),
    ],
)
def test_a_change_without_a_meaning_is_refused(changes, why, log):
    with pytest.raises(ScenarioError, match=why):
        changed_run(log, changes)


def test_a_log_that_lacks_a_measurement_runs_under_no_other_conditions(samples, tmp_path):
    lost = messages(samples, ch.ODOMETRY, "r1")[5]
    cut = changed(samples, ch.ODOMETRY, lambda x: None if x == lost else x)
    with pytest.raises(
        RerunError, match=f"measurement {lost.number} of r1, incarnation 1 is not in the log"
    ):
        changed_run(written(tmp_path / "log.mcap", cut), Changes())


def test_changes_and_the_first_place_of_each_localised_robot_are_printed(capsys):
    changes = (m.LandmarkChange(landmark=7, state="gone"),)
    print_changes(SimpleNamespace(map=SimpleNamespace(changes=changes)))
    poses = [
        example(
            m.PoseEstimate,
            stamp_ns=second * 10**9,
            robot="r1",
            frame=frame,
            pose=from_floats([second, 2.0, 0.0]),
        )
        for second, frame in ((1, "r1/0"), (3, "map-site/0"), (4, "map-site/0"))
    ]
    samples = [Sample(ch.TEAM_POSE.key("r1"), encoded(p), p.stamp_ns, 0, 0) for p in poses]
    print_placements(samples, 10**9)
    assert capsys.readouterr().out.splitlines() == [
        "changes: 1 gone (7)",
        "r1: placed first after 2.0 s at x 3.00 m, y 2.00 m, heading 0°",
    ]
