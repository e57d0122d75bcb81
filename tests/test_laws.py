"""The four laws of the design, tested on whole teams.

1 a measurement is used once; 2 a map is a pure function of a set of submaps; 3 every message names
its inputs; 4 a node does no I/O and reads no clock.
"""

import ast
import random
from functools import cache
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given, settings, strategies as st

import teamslam.sim.publisher.node
import teamslam.team.robot.node
from teamslam.central.config import CentralConfig
from teamslam.central.node import CentralNode, make_centre
from teamslam.sim.datasets.utias import write_utias
from teamslam.sim.in_memory.team import final_map
from teamslam.sim.publisher.node import WorldNode
from teamslam.sim.scenarios.scenario import load, with_options
from teamslam.sim.scenarios.source import streams_of
from teamslam.sim.studies.robots.node import ExchangingRobot
from teamslam.team import translate
from teamslam.team.pairs import PAIRS
from teamslam.team.robot.node import RobotNode, robot_node
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Outgoing, opened
from teamslam.team.wire.codec import encoded
from teamslam.team.wire.digest import NO_MAP, digest_of
from tests import build
from tests.scenarios import final_only, with_world
from tests.sim.reruns import team_samples
from tests.support import ROOT, fused_map
from tests.teams import Team, config, driven, of, published, stream, world_of

CENTRE = CentralConfig(tick_s=3.0, broadcast_s=3.0)
PAIR = world_of(stream("r1", 12, off_ns=300_000_000), stream("r2", 10, y=1.0, seen_every=2))


def team_of(streams, rng, **options):
    configs = [config(each.robot, pose_s=1e6, **options) for each in streams.streams]
    return Team(streams, configs, rng, CENTRE)


@pytest.fixture
def scarce(monkeypatch):
    monkeypatch.setattr(teamslam.sim.publisher.node, "CREDIT_MEASUREMENTS", 16)
    monkeypatch.setattr(teamslam.sim.publisher.node, "BATCH", 5)
    monkeypatch.setattr(teamslam.team.robot.node, "PROGRESS_MEASUREMENTS", 4)
    monkeypatch.setattr(teamslam.team.robot.node, "CREDIT_SUBMAPS", 1)


# Law 1.


def assert_each_measurement_once(samples):
    messages = [opened(sample) for sample in samples]
    counted = {}
    for _, name, message in messages:
        if isinstance(message, m.Measurement):
            counted.setdefault(name, set()).add((message.incarnation, message.number))
    submaps = {name: [] for name in counted}
    for _, name, message in messages:
        if isinstance(message, m.Submap):
            submaps[name].append(message)
    dones = [message for _, _, message in messages if isinstance(message, m.Done)]
    assert sorted(done.robot for done in dones) == sorted(counted)
    for done in dones:
        assert done.measurements == len(counted[done.robot])
        assert sum(entry.measurements for entry in done.ledger) == done.measurements
        mine = submaps[done.robot]
        assert [each.sequence for each in mine] == list(range(done.submaps))
        assert mine[0].first_measurement == 0
        for before, after in pairwise(mine):
            assert (after.first_measurement, after.start_ns) == (
                before.last_measurement + 1,
                before.stamp_ns,
            )
        outside = done.measurements - mine[-1].last_measurement - 1
        rejected = [e.measurements for e in done.ledger if e.disposition.startswith("rejected")]
        assert 0 <= outside <= sum(rejected)


@pytest.fixture(scope="module")
def utias(tmp_path_factory):
    folder = tmp_path_factory.mktemp("utias") / "MRCLAM_Dataset0"
    scenario = load("waypoints")
    write_utias(streams_of(with_world(scenario, steps=45)), folder)
    scenario = with_options(load("utias"), dataset=folder, robots=3)
    return scenario, team_samples(scenario)


def thesis():
    return with_world(load("thesis"), steps=45)


@cache
def samples_of_thesis():
    return team_samples(thesis())


def test_a_simulated_teams_measurements_are_each_used_once():
    assert_each_measurement_once(samples_of_thesis())


def test_a_data_sets_measurements_are_each_used_once(utias):
    scenario, samples = utias
    streams = streams_of(scenario)
    assert_each_measurement_once(samples)
    ends = {int(t) for each in streams.streams for t in each.intervals.end_ns}
    seen = {int(t) for each in streams.streams for t in each.landmark_detections.stamps_ns}
    assert seen - ends, "some are between the stamps of the odometry"
    assert len(final_map(samples).ids) > 0


def test_a_robots_submaps_are_the_same_bytes_without_a_centre(utias):
    for scenario, samples in ((thesis(), samples_of_thesis()), utias):
        for robot, each in zip(scenario.robots, streams_of(scenario).streams, strict=True):
            key = ch.SUBMAP.key(robot.id)
            in_team = [sample.payload for sample in samples if sample.key == key]
            alone = of(driven(RobotNode(robot), published(each)), ch.SUBMAP)
            assert in_team == [encoded(submap) for submap in alone]
            assert len(alone) >= 4


def test_a_rule_with_feedback_breaks_law_1_and_this_can_be_seen():
    """Mutant: the centre's messages change such a robot's contributions."""
    robot = config(fusion="kalman")
    measurements = published(PAIR.streams[0])
    maps = []
    for shift in (0.0, 1.0):
        node, out = robot_node(robot), []
        for measurement in measurements:
            new = node.handle(measurement)
            while new:
                out += new
                new = [
                    answer for x in of(new, ch.OWN_MAP) for answer in node.handle(_answer(x, shift))
                ]
        maps.append([encoded(x) for x in of(out, ch.OWN_MAP)])
    assert maps[0][0] == maps[1][0]
    assert maps[0][1:] != maps[1][1:]


def _answer(estimate, shift):
    means = translate.landmarks_of(estimate)[1]
    return fused_map(
        rule="kalman",
        frame="",
        exchange=estimate.exchange,
        joint=True,
        ids=estimate.ids,
        means=(means + shift).tobytes(),
        covariance=estimate.covariance,
    )


# Law 2.


EXPECTED = {}


def expected_final(streams=PAIR):
    if not EXPECTED:
        calm = team_of(streams, random.Random(0))
        calm.run()
        EXPECTED["bytes"] = encoded(calm.final)
    return EXPECTED["bytes"]


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32))
def test_the_final_map_is_the_same_bytes_for_any_interleaving(seed):
    team = team_of(PAIR, random.Random(seed))
    team.run()
    assert encoded(team.final) == expected_final()


@settings(deadline=None, max_examples=15)
@given(st.integers(0, 2**32), st.integers(0, 150), st.sampled_from(["r1", "r2"]))
def test_a_robot_that_dies_and_comes_back_changes_no_bit_of_it(seed, when, victim):
    team = team_of(PAIR, random.Random(seed))
    for _ in range(when):
        team.step()
    if not team.robots[victim].finished:
        team.kill(victim, patience=True)
        for _ in range(seed % 40):
            team.step()
        team.resume(team.robots[victim].config)
    team.run()
    assert encoded(team.final) == expected_final()
    assert team.robots[victim].finished


@cache
def messages():
    return [
        *(published(each)[0] for each in PAIR.streams),
        *(
            o.message
            for each in PAIR.streams
            for o in driven(RobotNode(config(each.robot, pose_s=1e6)), published(each))
            if o.channel in (ch.SUBMAP, ch.ROBOT_PROGRESS, ch.ROBOT_DONE)
        ),
        build.end(12_000_000_000, **{x.robot: len(x) for x in PAIR.streams}),
        *(build.liveliness(node=ch.robot_node(x.robot)) for x in PAIR.streams),
    ]


@settings(deadline=None, max_examples=40)
@given(
    st.deferred(lambda: st.permutations(range(len(messages())))),
    st.deferred(
        lambda: st.lists(
            st.tuples(st.sampled_from(range(len(messages()))), st.integers(0, 60)), max_size=10
        )
    ),
)
def test_the_centre_gives_the_same_map_for_any_order_duplicates_and_delays(order, again):
    heard = [messages()[i] for i in order]
    for i, at in again:
        if isinstance(messages()[i], m.Submap | m.Progress):
            heard.insert(at, messages()[i])
    node, out = CentralNode(CENTRE, ["r1", "r2"]), []
    for message in heard:
        out += node.handle(message)
    (final,) = of(out, ch.FINAL_MAP)
    assert encoded(final) == expected_final()


def test_a_submap_that_comes_behind_the_watermark_changes_no_bit_of_the_final_map():
    node, out = CentralNode(CENTRE, ["r1", "r2"]), []
    late = [x for x in messages() if isinstance(x, m.Submap) and x.robot == "r2"]
    lost = build.liveliness(node="robot/r2", alive=False)
    first = [
        x for x in messages() if getattr(x, "robot", "r1") != "r2" and not isinstance(x, m.End)
    ]
    first.sort(key=lambda x: not isinstance(x, m.Liveliness))
    for message in [*first[:2], lost, *first[2:]]:
        out += node.handle(message)
    closed = of(out, ch.FUSED_MAP)[-1]
    assert [member.robot for member in closed.members] == ["r1"]
    assert not closed.provisional
    rest = [x for x in messages() if x not in first and x not in late]
    for message in [late[0], build.liveliness(node="robot/r2"), *rest, *late[1:]]:
        out += node.handle(message)
    (final,) = of(out, ch.FINAL_MAP)
    assert encoded(final) == expected_final()


def test_the_final_map_does_not_depend_on_running_maps_and_poses():
    """Tests that read the final map alone publish neither."""
    maps, running = [], []
    for samples in (samples_of_thesis(), team_samples(final_only(thesis()))):
        fused = final_map(samples)
        maps.append((fused.ids, fused.means, fused.covariance))
        running.append(sum(each.key == ch.FUSED_MAP.key() for each in samples))
    assert maps[0] == maps[1]
    assert running[0] > 1 >= running[1]


# Law 3.


def test_configurations_maps_priors_and_poses_name_their_inputs():
    messages = [opened(each) for each in samples_of_thesis()]
    announced = {n: x for c, n, x in messages if c is ch.ROBOT_CONFIG}
    for each in announced.values():
        assert each.digest == digest_of(each.configuration.encode())
    maps = [x for _, _, x in messages if isinstance(x, m.FusedMap)]
    by_digest = {each.digest: each for each in maps}
    assert len(by_digest) == len(maps) >= 2
    priors = [x for _, _, x in messages if isinstance(x, m.Prior)]
    assert priors
    for prior in priors:
        members = {(x.robot, x.incarnation): x.sequence for x in by_digest[prior.digest].members}
        assert members[(prior.robot, prior.incarnation)] == prior.sequence
    submaps = [x for _, _, x in messages if isinstance(x, m.Submap)]
    assert {(x.robot, x.config) for x in submaps} == {(n, x.digest) for n, x in announced.items()}
    poses = [x for c, _, x in messages if c is ch.TEAM_POSE]
    assert {x.map_digest for x in poses} <= set(by_digest)
    assert {x.map_digest for c, _, x in messages if c is ch.OWN_POSE} == {NO_MAP}
    final = maps[-1]
    paths = [x for _, _, x in messages if isinstance(x, m.Trajectory)]
    assert {x.digest for x in paths} == {final.digest}


# Law 4.


TRUTH = {each for each in ch.CHANNELS if each.name.startswith("truth")}


@pytest.mark.parametrize("node", [WorldNode, RobotNode])
def test_no_node_listens_to_the_truth(node):
    assert not TRUTH & set(node.listens)
    assert {ch.TRUTH_LABELS, ch.TRUTH_POSITIONS} <= TRUTH


@pytest.mark.parametrize("fusion", sorted({fusion for _, fusion in PAIRS}))
def test_the_centre_listens_to_nothing_that_holds_the_truth_or_the_fused_map(fusion):
    fused = {ch.FUSED_MAP, ch.PRIOR, ch.FINAL_MAP, ch.TEAM_POSE}
    listens = set(make_centre(CentralConfig(fusion=fusion), ["r1"]).listens)
    assert not (TRUTH | fused) & listens


FORBIDDEN = {"time", "datetime", "zenoh", "mcap", "threading", "socket", "random", "os", "asyncio"}


def imports_of(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        if isinstance(node, ast.ImportFrom):
            found.add(node.module)
    return found


def reached_from(module: str) -> set[str]:
    seen, ahead = set(), [module]
    while ahead:
        name = ahead.pop()
        if name in seen:
            continue
        seen.add(name)
        path = ROOT / (name.replace(".", "/") + ".py")
        if path.is_file():
            ahead += imports_of(path)
    return seen


@pytest.mark.parametrize(
    "module", ["teamslam.team.robot.node", "teamslam.central.node", "teamslam.sim.publisher.node"]
)
def test_a_node_reaches_no_clock_no_socket_and_no_file(module):
    reached = reached_from(module)
    assert "teamslam.team.wire.messages" in reached
    assert not {name.split(".")[0] for name in reached} & FORBIDDEN


def test_a_shell_does_reach_them():
    reached = {name.split(".")[0] for name in reached_from("teamslam.team.robot.main")}
    assert {"time", "threading"} <= reached


# No deadlock.


def unequal(rng):
    """Robots that end early, see little, have no odometry, or are quicker than others."""
    streams = (
        stream(
            f"r{i + 1}",
            rng.choice([4, 9, 16]),
            y=float(i),
            step_ns=rng.choice([250_000_000, 10**9]),
            seen_every=rng.choice([1, 1, 6]),
            drives=rng.random() < 0.85,
            beyond=rng.choice([0, 0, 3]),
            known=i == 0 or rng.random() < 0.8,
        )
        for i in range(rng.choice([2, 2, 3]))
    )
    return world_of(*streams)


SEEDS = {
    "join": 40, "kalman": 10, "kalman-per-axis": 6, "covariance-intersection": 6, "latest": 4,
    "alone": 4, "joint-fastslam": 4, "batch": 4, "svd-join": 4, "svd-join-spherical": 4,
}  # fmt: skip


def played(seed, estimator, fusion):
    """Run a team in which a robot may die, and then restarts or is given up."""
    rng = random.Random(seed)
    team = team_of(unequal(rng), rng, estimator=estimator, fusion=fusion)
    if rng.random() < 0.4:
        for _ in range(rng.randrange(10, 150)):
            team.step()
        while team.world._began_at is None:  # a world that has not begun waits for everyone
            team.step()
        victim = rng.choice(sorted(team.robots))
        team.kill(victim)
        for _ in range(rng.randrange(30)):
            team.step()
        if rng.random() < 0.5:
            team.resume(team.robots[victim].config)
        else:
            order = build.given_up(node=ch.robot_node(victim), reason="it fell into the water")
            team.send("operator", [Outgoing(ch.GIVEN_UP, order.node, order)])
    team.run()
    return team


@pytest.mark.usefixtures("scarce")
@pytest.mark.parametrize(("estimator", "fusion"), sorted(PAIRS))
def test_every_team_comes_to_its_end_in_whatever_order_things_happen(estimator, fusion):
    for seed in range(SEEDS[fusion]):
        team = played(seed, estimator, fusion)
        assert team.centre.finished, f"the team of seed {seed} never ends"
        assert team.world.ended
        assert team.final.final
        for node in team.nodes.values():
            assert node.finished, f"seed {seed}"


@pytest.mark.usefixtures("scarce")
def test_a_waiting_robot_that_gives_no_credit_stalls_its_team(monkeypatch):
    """Mutant: the search finds a stall."""
    monkeypatch.setattr(ExchangingRobot, "consume", RobotNode.consume)
    assert not all(played(seed, "hybrid", "kalman").centre.finished for seed in range(40))
