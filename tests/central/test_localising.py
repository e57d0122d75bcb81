import dataclasses
import json
from functools import cache

import msgspec
import numpy as np
import pytest

from teamslam.central.desk.names import not_joined
from teamslam.central.desk.verification.centre import recompute_centre
from teamslam.central.desk.verification.recorded import Recorded, identity
from teamslam.central.desk.verification.robot import recompute_robot
from teamslam.central.localising import restricted
from teamslam.central.saved_maps import NothingToSaveError
from teamslam.sim.in_memory.team import final_map
from teamslam.sim.scenarios.scenario import load, with_options
from teamslam.sim.scenarios.source import streams_of
from teamslam.team import translate
from teamslam.team.recording.recorder import Recorder
from teamslam.team.saved_map import write_map
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.arrays import floats, from_ids, ids
from teamslam.team.wire.codec import encoded
from tests.central.test_saved_map import day, elsewhere, first_day, numbers, part, with_means
from tests.central.test_withdrawal import messages
from tests.commands import output_of
from tests.scenarios import selected
from tests.trials.day_two import judge, simulated, summary

SECOND_NS = 1_000_000_000


def beginning(scenario, length_s=60):
    whole = streams_of(scenario)
    first_ns = min(first for first, _ in whole.spans_ns.values())
    return part(whole, first_ns, first_ns + length_s * SECOND_NS, begins=False)


@cache
def short_day(*, localise=False, wrong=None, length_s=60):
    scenario = with_options(load("thesis-b"), seed=1001, localise=localise)
    streams = beginning(scenario, length_s)
    saved = first_day()[1] if wrong is None else with_means(wrong)
    return day(0, [saved], scenario=scenario, streams=streams)


def test_robots_without_a_start_are_placed_within_seconds_as_surely_as_stated():
    rows = [row for start in simulated(5) for row in judge(start)]
    found = summary(rows)
    assert found["robots"] == 10
    assert found["not_placed"] == found["wrong"] == 0
    assert found["worst_delay_s"] <= 10.0
    assert found["within_two_sigma"] >= 0.8


def test_a_prior_of_landmarks_alone_comes_first_and_then_one_with_a_pose():
    samples, _, _ = short_day()
    for robot in ("r1", "r2"):
        priors = [each for each in messages(samples, m.Prior) if each.robot == robot]
        first, *later = priors
        assert not first.in_team_frame
        assert first.frame == "map-site/0"
        assert len(ids(first.ids, "ids")) == 18
        assert len(floats(first.mean, "mean")) == 36
        assert later[0].in_team_frame


def test_a_map_of_another_site_places_no_robot():
    samples, _, _ = short_day(wrong=elsewhere)
    poses = messages(samples, m.PoseEstimate)
    assert poses
    assert not [each for each in poses if each.in_team_frame and each.frame.startswith("map-")]


@pytest.mark.parametrize("localise", [False, True])
def test_the_maps_priors_and_poses_are_computed_again_from_the_log(localise):
    samples, _, _ = short_day(localise=localise)
    log = Recorded()
    log.take_all(samples)
    computed = recompute_centre(log) | recompute_robot(log, "r1")
    for channel in (ch.FUSED_MAP, ch.FINAL_MAP, ch.PRIOR, ch.TEAM_POSE):
        outputs = log.outputs_of(channel)
        assert outputs
        for each in outputs:
            if channel is ch.TEAM_POSE and each.message.robot != "r1":
                continue
            again = computed[identity(each.sample.key, each.message)]
            assert encoded(again) == each.sample.payload


def test_localising_leaves_the_map_as_it_was_saved():
    samples, centre, _ = short_day(localise=True)
    saved, fused = first_day()[1], final_map(samples)
    assert numbers(fused) == numbers(saved)
    assert fused.frame == "map-site/0"
    for each in messages(samples, m.FusedMap):
        assert (each.ids, each.means) == (saved.ids, saved.means)
    assert {each.robot for each in messages(samples, m.Trajectory)} == {"r1", "r2"}
    with pytest.raises(NothingToSaveError):
        centre.maps.fold.save_map("later")


def test_a_landmark_that_the_map_lacks_is_left_out_of_submaps():
    saved = first_day()[1]
    submap = messages(short_day()[0], m.Submap)[0]
    own = ids(submap.ids, "ids")
    few = ids(saved.ids, "ids")
    assert restricted(submap, [saved]) is submap
    without = msgspec.structs.replace(saved, ids=from_ids(few[few != own[0]]))
    taken = restricted(submap, [without])
    taken.check()
    assert ids(taken.ids, "ids").tolist() == own[1:].tolist()
    whole, marginal = (translate.local_map_of(each) for each in (submap, taken))
    keep = np.delete(np.arange(len(whole.mean)), np.arange(2) + len(whole.mean) - 2 * len(own))
    assert (marginal.mean == whole.mean[keep]).all()
    assert (marginal.covariance == whole.covariance[np.ix_(keep, keep)]).all()
    assert np.allclose(marginal.sensitivity, whole.sensitivity[:, keep], rtol=1e-6)
    assert np.allclose(marginal.curvature, whole.curvature[:, keep], rtol=1e-6)


def test_localising_in_the_map_of_another_site_gives_no_path_and_the_same_map():
    samples, _, _ = short_day(localise=True, wrong=elsewhere)
    assert not messages(samples, m.Trajectory)
    assert final_map(samples).means == with_means(elsewhere).means


def reflected(points):
    return points * [1.0, -1.0]


@pytest.mark.parametrize("wrong", [reflected, elsewhere])
def test_a_wrong_map_is_named_with_the_remedy_and_no_robot_is_said_to_be_mirrored(wrong):
    samples, _, _ = short_day(localise=True, wrong=wrong, length_s=100)
    causes = [each.cause for of in messages(samples, m.FusedMap) for each in of.diagnosis]
    assert "mirrored" not in causes
    apart = dict(not_joined(final_map(samples).reasons))
    assert set(", ".join(apart).split(", ")) == {"r1", "r2"}
    assert not final_map(samples).joined
    for why in apart.values():
        assert "the saved map site" in why
        assert why.endswith("load the right map, or save a new one")


def test_the_command_localises_a_log_again(tmp_path):
    log, site, result = (tmp_path / name for name in ("log.mcap", "site.map", "x.json"))
    with Recorder(log, "small", {"seed": "1"}) as recorder:
        recorder.write(short_day()[0])
    write_map(site, first_day()[1])
    made = output_of("localise", "--map", site, log, "--json", result)
    assert "final map: the saved one, with poses and paths in its frame" in made
    figures = json.loads(result.read_text())["recomputed"]
    assert figures["landmarks"] == 18
    assert {each["state"] for each in figures["changes"]} <= {"unchanged"}
    assert "one saved map" in output_of("launch", "thesis-b", "--localise", status=2)


def without(world, robot, until_ns):
    streams = []
    for each in world.streams:
        seen = each.landmark_detections
        first = int(np.searchsorted(seen.stamps_ns, until_ns)) if each.robot == robot else 0
        own = seen.only(first, len(seen.stamps_ns))
        streams.append(dataclasses.replace(each, landmark_detections=own))
    return dataclasses.replace(world, streams=tuple(streams))


def test_a_robot_is_placed_by_the_saved_map_while_another_has_seen_nothing():
    """The one that has seen nothing is the team's map, for want of a start."""
    scenario = with_options(load("thesis-b"), seed=1001)
    streams = beginning(scenario)
    first_ns = min(first for first, _ in streams.spans_ns.values())
    streams = without(without(streams, "r1", 2**62), "r2", first_ns + 30 * SECOND_NS)
    samples, _, _ = day(0, [first_day()[1]], scenario=scenario, streams=streams)
    of_r2 = [each for each in messages(samples, m.Prior) if each.robot == "r2"]
    assert {each.frame for each in of_r2} == {"map-site/0"}
    assert {len(ids(each.ids, "ids")) for each in of_r2} == {18}


def of_first_landmarks(world, count):
    streams = []
    for each in world.streams:
        seen = each.landmark_detections
        known = list(dict.fromkeys(seen.ids.tolist()))[:count]
        own = selected(seen, np.isin(seen.ids, known))
        streams.append(dataclasses.replace(each, landmark_detections=own))
    return dataclasses.replace(world, streams=tuple(streams))


def test_two_landmarks_await_a_third_that_would_show_a_wrong_range():
    start = next(simulated(1))
    two, three = (
        judge(start._replace(world=of_first_landmarks(start.world, count))) for count in (2, 3)
    )
    assert [each["placed"] for each in two] == [True, True]
    assert all(4.0 <= each["delay_s"] < 10.0 for each in two)
    assert min(each["delay_s"] for each in three) < 4.0
