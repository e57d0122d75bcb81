import dataclasses
import json
from functools import cache

import msgspec
import numpy as np
import pytest

from teamslam.central import saved_maps
from teamslam.central.desk.evaluation.errors import transform_points
from teamslam.central.desk.evaluation.evaluation import evaluate
from teamslam.central.desk.verification.centre import recorded_map
from teamslam.central.desk.verification.recorded import Recorded
from teamslam.central.node import CentralNode, make_centre
from teamslam.central.saved_maps import NothingToSaveError, save_map
from teamslam.central.withdrawal import Trial
from teamslam.sim.in_memory.team import final_map, run_team
from teamslam.sim.scenarios.scenario import ScenarioError, load, with_options
from teamslam.sim.scenarios.source import streams_of
from teamslam.sim.world.streams import WorldStreams
from teamslam.team.core import unpacked
from teamslam.team.estimation.map_joining import hypotheses
from teamslam.team.estimation.map_joining.alignment import Maps, align, procrustes
from teamslam.team.recording.recorder import Recorder
from teamslam.team.saved_map import SavedMapError, map_figures, read_map, write_map
from teamslam.team.store import SubmapStore
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.arrays import floats, from_floats, ids
from teamslam.team.wire.bus import opened
from teamslam.team.wire.codec import WireError, decoded, encoded
from tests import build
from tests.air import Air
from tests.bits import SETS
from tests.commands import output_of, run
from tests.peer_team import PeerTeam, peer_world
from tests.scenarios import final_only, scenario_in, with_world
from tests.support import example
from tests.trials.stress_world import MovedLandmark, StressWorld, write

ALL = ("*",)


def displaced(scenario, moved):
    places = np.array(scenario.world.landmarks)
    for number, by in moved:
        places[number - 1] += by
    return tuple(map(tuple, places.tolist()))


def day(seed, maps=(), *, moved=(), unknown=(), scenario="thesis-b", streams=None):
    day_of = msgspec.structs.replace(load(scenario), seed=seed) if streams is None else scenario
    if streams is None:
        landmarks = displaced(day_of, moved)
        day_of = final_only(with_world(day_of, landmarks=landmarks, unknown_starts=unknown))
        streams = streams_of(day_of)
    centres = []

    def central(config, names) -> CentralNode:
        centres.append(make_centre(config, names, maps=maps))
        return centres[-1]

    return list(run_team(day_of, streams, central=central)), centres[0], streams


@cache
def first_day():
    samples, centre, _ = day(1)
    return samples, centre.maps.fold.save_map("site"), centre


@cache
def second_day(loaded=True, moved=(), unknown=()):
    maps = [first_day()[1]] if loaded else []
    return day(1001, maps, moved=moved, unknown=unknown)


def covariance_of(saved: m.FusedMap | m.SavedMap) -> np.ndarray:
    return unpacked(floats(saved.covariance, "covariance"), 2 * len(ids(saved.ids, "ids")))


def errors(fused: m.FusedMap, streams: WorldStreams):
    found = ids(fused.ids, "ids")
    truth = streams.landmarks[np.searchsorted(streams.landmark_ids, found)]
    return aligned_errors(truth, floats(fused.means, "means").reshape(-1, 2), covariance_of(fused))


def aligned_errors(truth: np.ndarray, means: np.ndarray, P: np.ndarray) -> tuple[float, float]:
    """RMSE [m] and NEES per degree of freedom after alignment."""
    fit = align(Maps(truth, 1e-12 * np.eye(len(P)), means, P))
    off = truth - transform_points(procrustes(truth, means, np.ones(len(truth))), means)
    return float(np.sqrt((off**2).sum(axis=1).mean())), fit.chi2 / fit.dof


def changed(fused: m.FusedMap):
    return {each.landmark: each for each in fused.changes if each.state != "unchanged"}


def place_of(number: int, of: m.FusedMap | m.SavedMap):
    at = ids(of.ids, "ids").tolist().index(number)
    return floats(of.means, "means").reshape(-1, 2)[at]


def numbers(fused: m.FusedMap):
    return fused.ids, fused.means, fused.covariance


def test_a_second_day_joins_the_saved_map_and_is_more_accurate():
    samples, _, streams = second_day()
    alone = final_map(second_day(loaded=False)[0])
    fused = final_map(samples)
    assert {each.robot for each in fused.members} == {"map-site", "r1", "r2"}
    assert [each.state for each in fused.changes] == ["unchanged"] * 18
    assert errors(fused, streams)[0] < errors(alone, streams)[0]
    assert fused.frame == alone.frame == "r1/1"
    assert not [s for s in samples if s.key == ch.TRAJECTORY.key("map-site")]


def test_without_a_known_start_the_teams_frame_is_that_of_the_saved_map():
    samples, _, _ = second_day(unknown=ALL)
    fused = final_map(samples)
    assert fused.frame == "map-site/0"
    means = floats(fused.means, "means") - floats(first_day()[1].means, "means")
    assert np.abs(means).max() < 0.3


@pytest.mark.parametrize("localise", [False, True])
def test_a_day_that_the_map_contains_fails_and_gives_no_advice_about_sigmas(tmp_path, localise):
    scenario = final_only(with_options(load("thesis-b"), seed=1, localise=localise))
    saved = first_day()[1]
    samples, centre, _ = day(1, [saved], scenario=scenario, streams=streams_of(scenario))
    said = "; ".join(centre.findings)
    failures = [each for each in evaluate(samples).failures if "count twice" in each]
    assert len(failures) == (0 if localise else 2)
    for robot in ("r1", "r2"):
        assert f"{robot}'s measurements of this day are in the saved map site already" in said
    assert "map-site: the submaps' covariances are too large" in said
    assert "sigmas" not in said
    assert "already" not in "; ".join(second_day()[1].findings)
    if localise:
        return
    log = recorded(tmp_path / "log.mcap", samples)
    save = output_of("map", "save", log, "-o", tmp_path / "twice.map", status=1)
    assert "r1's measurements of this day are in the saved map site already" in save
    assert not (tmp_path / "twice.map").exists()


def recorded(path, samples):
    with Recorder(path, "small", {"seed": "1"}) as recorder:
        recorder.write(samples)
    return path


@pytest.mark.parametrize("moved", [((15, (0.5, 0.0)),), tuple((k, (3.0, 2.0)) for k in (2, 8, 11))])
def test_what_has_moved_is_found_and_nothing_else(moved):
    """The moved landmark is separated, and the map is as accurate as without the old one."""
    samples, _, streams = second_day(moved=moved)
    fused = final_map(samples)
    found = changed(fused)
    assert list(found) == [number for number, _ in moved]
    for number, by in moved:
        assert found[number].state == "moved"
        off = np.array([found[number].dx, found[number].dy]) - by
        assert (np.abs(off) < 4.0 * found[number].sigma).all()
    rmse, nees = errors(fused, streams)
    assert rmse < 0.1
    assert nees < 2.0


def test_a_landmark_that_is_not_seen_again_is_gone_and_is_not_saved_again():
    samples, centre, _ = second_day(moved=((15, (-900.0, -900.0)),))
    gone = changed(final_map(samples))
    assert {number: each.state for number, each in gone.items()} == {15: "gone"}
    assert gone[15].expected > 7.0
    saved = centre.maps.fold.save_map("later")
    assert 15 not in ids(saved.ids, "ids")


@pytest.mark.parametrize("detections", [1, 40])
def test_one_misread_number_does_not_move_a_landmark_that_is_gone(detections):
    """As an outlier in a submap, or as this submap's place."""
    _, _, streams = second_day(moved=((15, (-900.0, -900.0)),))
    first, *rest = streams.streams
    seen = first.landmark_detections
    wrong = seen.ids.copy()
    span = slice(287, 287 + detections)
    wrong[span][wrong[span] == wrong[287]] = 15
    misread = dataclasses.replace(first, landmark_detections=dataclasses.replace(seen, ids=wrong))
    day_of = msgspec.structs.replace(load("thesis-b"), seed=1001)
    world = dataclasses.replace(streams, streams=(misread, *rest))
    samples, centre, _ = day(0, [first_day()[1]], scenario=day_of, streams=world)
    fused = final_map(samples)
    assert 15 in ids(fused.ids, "ids"), "the misread number is in the map"
    gone = changed(fused)
    assert {number: each.state for number, each in gone.items()} == {15: "gone"}
    former, place = (place_of(15, each) for each in (first_day()[1], fused))
    assert (np.abs(place - former).max() > 5.0) == (detections > 1)
    assert np.abs(place - [gone[15].dx, gone[15].dy] - former).max() < 0.5
    saved = centre.maps.fold.save_map("later")
    assert 15 not in ids(saved.ids, "ids")


def test_a_running_centre_saves_the_map_of_its_present_set():
    samples, _, centre = first_day()
    members = [s for s in samples if s.key.endswith(("/start", "/submap"))]
    config, robots = msgspec.structs.replace(centre.config, broadcast_s=10.0), list(centre.robots)
    half, undisturbed = make_centre(config, robots), make_centre(config, robots)
    request = encoded(m.FoldRequest(stamp_ns=0))
    with pytest.raises(NothingToSaveError):
        half.answer_site(request)
    for number, sample in enumerate(members):
        message = opened(sample)[2]
        assert [encoded(o.message) for o in half.handle(message)] == [
            encoded(o.message) for o in undisturbed.handle(message)
        ]
        if number == len(members) // 2:
            early = decoded(half.answer_site(request)[0], m.SavedMap)
    whole = decoded(half.answer_site(request)[0], m.SavedMap)
    assert whole == first_day()[1]
    assert early.sets == whole.sets
    assert len(whole.sets) == len(robots)
    assert np.trace(covariance_of(early)) > np.trace(covariance_of(whole))


def test_two_saves_of_a_day_count_once_though_an_earlier_robot_came_between():
    samples, centre, _ = second_day(loaded=False)
    fold = type(centre.maps.fold)(centre.config, centre.config_digest)
    saves = []
    for robot in ("r2", "r1"):
        for sample in samples:
            message = opened(sample)[2]
            if isinstance(message, m.InitialPose | m.Submap) and message.robot == robot:
                fold.store.add(message)
        fold.make_map("final")
        saves.append(fold.save_map(f"after_{robot}"))
    assert [len(each.sets) for each in saves] == [1, 2]
    store = SubmapStore()
    assert store.add(saves[0]) is None
    assert "in common" in str(store.add(saves[1]))


def test_a_change_that_chance_may_explain_leaves_todays_place_uncertain_by_it():
    """An error of 4 sigma must not replace years of measurements as a move."""
    _, centre, _ = second_day()
    fold, fused = centre.maps.fold._final
    by = np.array([0.5, -0.2])

    def covariance(chi2):
        moved = m.LandmarkChange(landmark=15, state="moved", dx=by[0], dy=by[1], chi2=chi2)
        with_move = msgspec.structs.replace(fused, changes=(moved,))
        return covariance_of(save_map(fold, with_move, "later", {}, [bytes(8)]))

    more = covariance(20.0) - covariance(40.0)
    at = 2 * ids(fused.ids, "ids").tolist().index(15)
    block = more[at : at + 2, at : at + 2].copy()
    more[at : at + 2, at : at + 2] = 0.0
    assert np.allclose(block, np.outer(by, by))
    assert np.abs(more).max() < 1e-12


def test_more_days_do_not_make_the_scale_of_a_map_certain(monkeypatch):
    fold = second_day()[1].maps.fold
    saved = fold.save_map("later")
    monkeypatch.setattr(saved_maps, "SCALE", 0.0)
    more, less = covariance_of(saved), covariance_of(fold.save_map("later"))
    points = floats(saved.means, "means").reshape(-1, 2)
    away = 3e-4 * (points - points.mean(axis=0)).ravel()
    assert np.allclose(more - less, np.outer(away, away), atol=1e-12)


def with_means(change):
    saved = first_day()[1]
    points = floats(saved.means, "means").reshape(-1, 2)
    return msgspec.structs.replace(saved, means=from_floats(change(points)))


def elsewhere(points):
    return np.random.default_rng(1).uniform(0.0, 100.0, points.shape)


@pytest.mark.parametrize("change", [lambda points: points * [1.0, -1.0], elsewhere])
def test_a_mirrored_map_or_one_of_another_site_is_refused_and_changes_nothing(change):
    samples, centre, _ = day(1001, [with_means(change)])
    fused = final_map(samples)
    assert numbers(fused) == numbers(final_map(second_day(loaded=False)[0]))
    assert any("the saved map site not joined" in each for each in fused.reasons)
    assert not {*centre.maps.fold.save_map("later").sets} & {*first_day()[1].sets}


def test_a_map_of_which_half_the_landmarks_have_moved_is_withdrawn_and_changes_nothing():
    moved = tuple((k, (3.0 + k, 5.0 - k)) for k in range(1, 10))
    samples, centre, _ = second_day(moved=moved)
    fused = final_map(samples)
    assert numbers(fused) == numbers(final_map(second_day(loaded=False, moved=moved)[0]))
    words = " ".join((*centre.warnings, *fused.reasons))
    assert "elsewhere" in words or "disagree" in words


def test_running_maps_await_the_final_one_where_a_landmark_of_a_saved_map_has_two_places(
    monkeypatch,
):
    fold = day(1001, [first_day()[1]])[1].maps.fold

    def explain(island):
        robots, figures = frozenset({"r1"}), (0, (0.5, 0.0), (0.01,), 99.0, 2)
        return [
            hypotheses.Hypothesis("identity_shared", id_, robots, *figures, island)
            for id_ in (4, 1000)
        ], island

    monkeypatch.setattr(hypotheses, "explain", explain)

    def named(tail):
        causes = fold.make_map(tail)[0 if tail == "closed" else -1].message.diagnosis
        return {each.landmark for each in causes if each.cause == "identity_shared"}

    assert named("closed") == {1000}
    assert named("final") == {4, 1000}


@pytest.mark.parametrize("opposed", [("map-site", "r1"), ("r1", "r2")])
def test_a_running_map_asks_nobody_to_withdraw_a_saved_map(opposed, monkeypatch):
    words = f"{', '.join(opposed)} contradict each other"
    trial = Trial(undecided=words, opposed=opposed)
    ticks = day(1001, [first_day()[1]])[1].maps.fold._ticks
    monkeypatch.setattr(ticks, "_try_robots", lambda *_: trial)
    assert not ticks._convict(ticks.fold, 30.0)
    assert ticks.undecided == ("" if "map-site" in opposed else words)
    assert not ticks._convict(ticks.fold, np.inf)
    assert ticks.undecided == words


def test_a_withdrawn_map_leaves_the_bytes_of_a_day_without_it():
    samples, _, _ = second_day()
    _, centre, _ = second_day(loaded=False)
    fold = type(centre.maps.fold)(centre.config, centre.config_digest)
    for message in (opened(each)[2] for each in samples):
        if isinstance(message, m.InitialPose | m.Submap):
            fold.store.add(message)
    fold.store.add(first_day()[1])
    joined = fold.make_map("final")[-1].message
    assert numbers(joined) == numbers(final_map(samples))
    order = build.withdrawal(robot="map-site", reason="old")
    fold.store.add(order)
    without = fold.make_map("final")[-1].message
    assert numbers(without) == numbers(final_map(second_day(loaded=False)[0]))
    assert without.withdrawn == ("map-site",)


def test_the_saved_map_of_a_log_is_that_of_its_centre():
    samples, centre, _ = second_day()
    log = Recorded()
    log.take_all(samples)
    assert recorded_map(log, "both") == centre.maps.fold.save_map("both")


def test_a_chain_of_days_stays_one_map_of_the_same_size_and_consistent():
    figures, sizes = [], []
    for seed in (1, 2):
        maps = []
        for each in range(4):
            samples, centre, streams = day(seed + 1000 * each, maps, unknown=ALL if maps else ())
            maps = [centre.maps.fold.save_map(f"day{each}")]
            figures.append((each, *errors(final_map(samples), streams)))
            sizes.append(len(maps[0].covariance))
        assert len(maps[0].sets) == 8
    assert len(set(sizes)) == 1
    first = np.mean([rmse for each, rmse, _ in figures if each == 0])
    last = np.mean([rmse for each, rmse, _ in figures if each == 3])
    assert last < 0.7 * first
    assert 0.6 < np.mean([nees for each, _, nees in figures if each]) < 1.4


def test_peers_spread_a_saved_map_that_one_of_them_has_loaded():
    scenario = load("thesis-b")
    scenario = msgspec.structs.replace(with_world(scenario, steps=60), seed=7)
    team = PeerTeam(scenario, Air())
    team.seats["r2"].node.load_maps([first_day()[1]])
    list(team.run(peer_world(scenario, streams_of(scenario))))
    finals = [encoded(seat.node.final) for seat in team.seats.values()]
    assert finals[0] == finals[1]
    assert "map-site" in {each.robot for each in decoded(finals[0], m.FusedMap).members}


def test_the_file_is_read_as_written_and_a_wrong_one_is_named_with_the_remedy(tmp_path):
    saved, path = first_day()[1], tmp_path / "site.map"
    write_map(path, saved)
    assert read_map(path) == saved
    figures = map_figures(saved)
    assert [each["landmark"] for each in figures["landmarks"]] == list(range(1, 19))
    payload = path.read_bytes()
    for content, words in (
        (b"", "cut off"),
        (b"landmark,x,y\n", "no saved map"),
        (encoded(final_map(first_day()[0])), "no saved map"),
        (payload.replace(b"saved_map/1", b"saved_map/9"), "another version"),
        (payload[:-200], "cut off"),
    ):
        path.write_bytes(content)
        with pytest.raises(SavedMapError, match=words) as caught:
            read_map(path)
        assert str(path) in str(caught.value)
    with pytest.raises(SavedMapError, match="cannot be read"):
        read_map(tmp_path / "none.map")
    with pytest.raises(SavedMapError, match=f"teamslam map save {tmp_path} -o site.map"):
        read_map(tmp_path)


@pytest.mark.parametrize(
    ("days", "words"),
    [
        (("1", "12"), "second.map contains the measurements of {first}"),
        (("1", "1"), "maps of the same measurements: load one of them"),
        (("12", "13"), "have measurements in common"),
    ],
)
def test_maps_with_measurements_in_common_are_refused_before_a_run(tmp_path, days, words):
    first, second = tmp_path / "first.map", tmp_path / "second.map"
    for file, of in zip((first, second), days, strict=True):
        sets = tuple(day.encode() * 8 for day in of)
        write_map(file, example(m.SavedMap, name=file.stem, sets=sets))
    for command in (("rerun", tmp_path), ("launch", "thesis-b", "-o", tmp_path / "run")):
        for files in ((first, second), (second, first)):
            maps = [word for file in files for word in ("--map", file)]
            refusal = " ".join(output_of(*command, *maps, status=2).split())
            assert words.format(first=first) in refusal
            assert str(first) in refusal
            assert str(second) in refusal
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"covariance": from_floats([1, 0, 0, 2, 1, 0, 0, 1, 0, 1])}, "positive"),
        ({"means": from_floats([1.0, np.nan, 0.0, 0.0])}, "finite"),
        ({"sensitivity": b""}, "length"),
        ({"counts": bytes(8)}, "length"),
        ({"sets": ()}, "bounds"),
        ({"name": "A map"}, "wrong field"),
    ],
)
def test_the_door_refuses_an_unsound_map(fields, words):
    with pytest.raises(WireError, match=words):
        decoded(encoded(example(m.SavedMap, **fields)), m.SavedMap)


def test_two_maps_with_a_day_in_common_would_count_it_twice():
    saved = first_day()[1]
    sets = tuple(sorted((*saved.sets, b"8 bytes!")))
    later = msgspec.structs.replace(saved, name="later", sets=sets)
    store = SubmapStore()
    assert store.add(saved) is None
    assert store.add(saved) is None
    assert "in common" in str(store.add(later))
    other = msgspec.structs.replace(saved, means=from_floats(floats(saved.means, "means") + 1.0))
    assert "differs" in str(store.add(other))
    assert store.arrived == 1


def classed(seed, classes):
    day_of, world = hidden(seed)
    streams = []
    for each in world.streams:
        seen = each.landmark_detections
        rows = np.full((len(seen.ids), 3), np.log(0.1))
        rows[np.arange(len(rows)), classes(seen.ids)] = np.log(0.8)
        own = dataclasses.replace(seen, classes=rows)
        streams.append(dataclasses.replace(each, landmark_detections=own))
    return day_of, dataclasses.replace(world, streams=tuple(streams))


def test_a_map_without_identities_is_saved_with_classes_which_tell_it_from_another():
    scenario, streams = classed(1, lambda ids: ids % 3)
    samples, centre, _ = day(1, scenario=scenario, streams=streams)
    saved = centre.maps.fold.save_map("site")
    rows = floats(saved.classes, "classes").reshape(-1, 3)
    means = floats(saved.means, "means").reshape(-1, 2)
    off = np.hypot(*(means[:, None] - streams.landmarks).transpose(2, 0, 1))
    sure = off.min(axis=1) < 0.3
    assert sure.sum() > 10
    assert (rows.argmax(axis=1) == streams.landmark_ids[off.argmin(axis=1)] % 3)[sure].all()
    for shift, joins in ((0, True), (1, False)):
        scenario, streams = classed(1001, lambda ids, by=shift: (ids + by) % 3)
        samples, _, _ = day(1, [saved], scenario=scenario, streams=streams)
        reasons = final_map(samples).reasons
        assert any("the saved map site not joined" in each for each in reasons) != joins


def hidden(seed, moved=()):
    day_of = with_options(msgspec.structs.replace(load("thesis-b"), seed=seed), identities="hidden")
    day_of = final_only(with_world(day_of, landmarks=displaced(day_of, moved)))
    return day_of, streams_of(day_of)


@cache
def hidden_site() -> m.SavedMap:
    scenario, streams = hidden(1)
    _, centre, _ = day(1, scenario=scenario, streams=streams)
    return centre.maps.fold.save_map("site")


@pytest.mark.parametrize(("number", "by"), [(15, (1.0, -0.5)), (8, (0.6, 0.3))])
def test_a_landmark_without_identity_that_has_moved_is_found_and_nothing_else(number, by):
    scenario, streams = hidden(1001, [(number, by)])
    samples, _, _ = day(1, [hidden_site()], scenario=scenario, streams=streams)
    (found,) = changed(final_map(samples)).values()
    assert found.state == "moved"
    assert (np.abs([found.dx - by[0], found.dy - by[1]]) < 4.0 * found.sigma).all()


def test_a_landmark_without_identity_beyond_the_gate_is_gone_and_another_is_new():
    scenario, streams = hidden(1001, [(15, (3.0, -1.5))])
    profile = scenario.central.association
    assert np.sqrt(profile.gate) * profile.slack < np.hypot(3.0, 1.5)
    samples, _, _ = day(1, [hidden_site()], scenario=scenario, streams=streams)
    states = sorted(each.state for each in changed(final_map(samples)).values())
    assert states == ["gone", "new"]


MOVED_AT_S = 200.0


def two_days(by, folder):
    """Two days of one recording; landmark 7 has been moved in between."""
    world = StressWorld(
        seed=1,
        robots=2,
        seconds=2.0 * MOVED_AT_S,
        hidden=True,
        moved=(MovedLandmark(7, by, MOVED_AT_S),),
    )
    scenario = final_only(scenario_in(write(world, folder)))
    streams = streams_of(scenario)
    begins_ns, ends_ns = zip(*streams.spans_ns.values(), strict=True)
    middle_ns = round(MOVED_AT_S * 1e9)
    first = part(streams, min(begins_ns), middle_ns, begins=True)
    return scenario, first, part(streams, middle_ns, max(ends_ns), begins=False)


@pytest.mark.parametrize("by", [(0.5, 0.0), (0.4, -0.3)])
def test_a_landmark_that_association_takes_for_another_within_the_gate_has_moved(by, tmp_path):
    """Its places are no pair of the association, or one submap has it at the former place."""
    scenario, first, second = two_days(by, tmp_path)
    _, centre, _ = day(1, scenario=scenario, streams=first)
    saved = centre.maps.fold.save_map("site")
    samples, centre, _ = day(1, [saved], scenario=scenario, streams=second)
    fused = final_map(samples)
    (found,) = (each for each in changed(fused).values() if each.state != "new")
    assert found.state == "moved"
    assert (np.abs([found.dx - by[0], found.dy - by[1]]) < 4.0 * found.sigma).all()
    later = centre.maps.fold.save_map("later")
    here = np.array(place_of(found.landmark, fused))
    away = np.hypot(*(floats(later.means, "means").reshape(-1, 2) - here).T)
    assert (away < 1.0).sum() == 1


def test_the_commands_save_show_and_load_a_map(tmp_path):
    log = recorded(tmp_path / "log.mcap", first_day()[0])
    later = recorded(tmp_path / "later.mcap", second_day(loaded=False)[0])
    site, result = tmp_path / "site.map", tmp_path / "x.json"
    output_of("map", "save", log, "-o", site)
    assert read_map(site) == first_day()[1]
    shown = output_of("map", "show", site, "--json", result)
    assert "landmark,x,y,sigma_x,sigma_y,submaps" in shown
    assert len(json.loads(result.read_text())["landmarks"]) == 18
    rerun = ("rerun", later, "--map", site, "--json", result)
    output_of(*rerun)
    changes = json.loads(result.read_text())["recomputed"]["changes"]
    assert [each["state"] for each in changes] == ["unchanged"] * 18
    assert {"landmark", "state", "dx_m", "dy_m", "sigma_m", "chi2"} <= changes[0].keys()
    for options in ([], ["--window", "8"]):
        twice = run("rerun", log, "--map", site, *options)
        assert isinstance(twice.exception, ScenarioError)  # status 2 of the program
        assert "r1's measurements of this day are in the saved map site" in str(twice.exception)
        assert "recorded" not in twice.output
    write_map(site, with_means(elsewhere))
    wrong = output_of(*rerun)
    (warning,) = json.loads(result.read_text())["recomputed"]["warnings"]
    assert warning["cause"] == "saved_map_not_joined"
    assert "the saved map site is not in the team's map: 18 shared landmarks" in warning["text"]
    assert warning["text"].endswith("load the right map, or save a new one")
    assert f"warning: {warning['text']}" in wrong
    for words in (("map", "show", log), ("rerun", log, "--map", log)):
        assert "no saved map" in output_of(*words, status=2)
    assert "--name" in output_of("map", "save", log, "-o", tmp_path / "A map.map", status=2)


def part(world: WorldStreams, first_ns: int, last_ns: int, *, begins: bool) -> WorldStreams:
    streams = []
    for each in world.streams:
        of = each.intervals
        inside = (of.end_ns - of.duration_ns >= first_ns) & (of.end_ns <= last_ns)
        rows = {
            field.name: getattr(of, field.name)[inside]
            for field in dataclasses.fields(of)
            if isinstance(getattr(of, field.name), np.ndarray)
        }
        start_ns = each.start_ns if begins else int((of.end_ns - of.duration_ns)[inside][0])
        seen = [
            found.only(*np.searchsorted(found.stamps_ns, [start_ns, last_ns]).tolist())
            for found in (each.landmark_detections, each.teammate_detections)
        ]
        own = {"intervals": dataclasses.replace(of, **rows), "start_ns": start_ns}
        own |= {"landmark_detections": seen[0], "teammate_detections": seen[1]}
        start = each.start if begins else None
        streams.append(dataclasses.replace(each, start=start, **own))
    return dataclasses.replace(world, streams=tuple(streams))


@pytest.mark.skipif(not (SETS / "MRCLAM_Dataset1.zip").is_file(), reason="the data are not here")
def test_two_halves_of_a_real_session_give_the_map_of_one_session():
    scenario = with_options(load("utias"), dataset=SETS / "MRCLAM_Dataset1.zip", robots=3)
    scenario = final_only(scenario)
    world = streams_of(scenario)
    first_ns = min(first for first, _ in world.spans_ns.values())
    at = [first_ns + each * 250_000_000_000 for each in range(3)]
    halves = part(world, at[0], at[1], begins=True), part(world, at[1], at[2], begins=False)
    _, centre, _ = day(1, scenario=scenario, streams=halves[0])
    saved = centre.maps.fold.save_map("first")
    samples, _, _ = day(1, [saved], scenario=scenario, streams=halves[1])
    whole, _, _ = day(1, scenario=scenario, streams=part(world, at[0], at[2], begins=True))
    assert not changed(final_map(samples))
    assert final_map(samples).frame == "map-first/0"
    assert errors(final_map(samples), world)[0] < 1.05 * errors(final_map(whole), world)[0]
