import msgspec
import pytest

from teamslam.central.config import CentralConfig
from teamslam.central.node import CentralNode
from teamslam.sim.publisher.node import WorldNode
from teamslam.team.config import RobotConfig
from teamslam.team.containment import Boundary, Handler
from teamslam.team.door import LATE_NS, MOST_COUNT, MOST_LIVES, Door
from teamslam.team.robot.node import RobotNode
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Outgoing, Sample, read_reply
from teamslam.team.wire.codec import WireError, encoded
from teamslam.team.wire.digest import announce_configuration
from tests import build
from tests.support import example, submap
from tests.teams import Submaps, of, published, stream, world_of

HUGE = 2**62
STREAMS = {name: stream(name, 12, y=y) for name, y in (("r1", 0.0), ("r2", 1.0))}
MEASUREMENTS = {name: published(each) for name, each in STREAMS.items()}
SUBMAPS = Submaps(list(STREAMS.values()))
COUNTS = {name: len(each) for name, each in STREAMS.items()}
END = build.end(**COUNTS)


def sample(channel: ch.Channel, name: str, message: m.Message) -> Sample:
    return Sample(channel.key(name), encoded(message), message.stamp_ns, 0, 0)


def given(
    boundary: Boundary, node: Handler, *said: tuple[ch.Channel, str, m.Message]
) -> list[Outgoing]:
    return [out for each in said for out in boundary.take(node, sample(*each))]


def progress(robot: str, measurements: int, submaps: int, stamp_s: float = 12.0) -> m.Progress:
    return build.progress(
        stamp_ns=round(stamp_s * 1e9), robot=robot, measurements=measurements, submaps=submaps
    )


def run() -> list[tuple[ch.Channel, str, m.Message]]:
    said: list[tuple[ch.Channel, str, m.Message]] = []
    for name, submaps in SUBMAPS.items():
        here = build.liveliness(node=f"robot/{name}")
        count = len(MEASUREMENTS[name])
        said += [(ch.ALIVE, f"robot/{name}", here), (ch.START, name, MEASUREMENTS[name][0])]
        said += [(ch.SUBMAP, name, submap) for submap in submaps]
        said.append((ch.ROBOT_PROGRESS, name, progress(name, count, len(submaps))))
    for name, submaps in SUBMAPS.items():
        counts = {"measurements": len(MEASUREMENTS[name]), "steps": 12, "submaps": len(submaps)}
        said.append((ch.ROBOT_DONE, name, build.done(stamp_ns=12 * 10**9, robot=name, **counts)))
    return [*said, (ch.END, "", END)]


STRANGE = msgspec.structs.replace(submap(0), robot="r9")
ATTACKS = [
    (ch.SUBMAP, "r9", STRANGE, "of r9, not in this team"),
    (ch.START, "r1", build.initial_pose(incarnation=HUGE), f"of incarnation {HUGE}"),
    (ch.ROBOT_DONE, "r1", build.done(incarnation=HUGE), f"of incarnation {HUGE}"),
    (ch.ROBOT_DONE, "r1", build.done(measurements=5, submaps=HUGE), f"counts to {HUGE}"),
    (ch.ROBOT_PROGRESS, "r1", progress("r1", 5, HUGE), f"counts to {HUGE}"),
    (ch.ROBOT_PROGRESS, "r1", progress("r1", 5, 1, 4e9), "days after its stream began"),
    (ch.ROBOT_PROGRESS, "r1", progress("r2", 5, 1), "a message of 'r2' on the key"),
    (ch.ROBOT_PROGRESS, "r1", build.progress(node="central"), "a message of 'central'"),
    (ch.END, "", build.end(), "an end that omits r1, r2"),
    (ch.END, "", build.end(**dict.fromkeys(STREAMS, 3)), "ends with measurement 3"),
    (ch.END, "", build.end(**COUNTS, r9=3), "of r9, not in this team"),
    (ch.ORDER, "r1", build.withdrawal(by="central"), "a message of 'central' on the key"),
    (ch.ORDER, "r9", build.withdrawal(robot="r9"), "of r9, not in this team"),
]


def centre() -> tuple[Boundary, CentralNode]:
    node = CentralNode(CentralConfig(tick_s=3.0, broadcast_s=3.0), ("r1", "r2"))
    return Boundary("central"), node


def test_a_centre_refuses_what_can_not_be_and_its_map_stays():
    plain, node = centre()
    (wanted,) = of(given(plain, node, *run()), ch.FINAL_MAP)
    assert plain.refused == 0, plain.last_refused
    boundary, node = centre()
    said = run()
    out = given(boundary, node, *said[:-1])
    for count, (channel, name, message, why) in enumerate(ATTACKS, 1):
        out += given(boundary, node, (channel, name, message))
        assert boundary.refused == count, why
        assert why in boundary.warnings[0]
    last = f"{len(ATTACKS)} dropped at the door, the last: operator/withdrawal/r9: of r9"
    assert last in boundary.warnings[0]
    out += given(boundary, node, said[-1])
    (final,) = of(out, ch.FINAL_MAP)
    assert encoded(final) == encoded(wanted)


def test_a_robot_refuses_what_can_not_be_of_its_stream_and_sends_the_same_submaps():
    def robot() -> tuple[Boundary, RobotNode]:
        return Boundary("robot/r1"), RobotNode(RobotConfig("r1"))

    channel_of = {kind: channel for channel in ch.SENSORS for kind in channel.kinds}
    measurements = [(channel_of[type(each)], "r1", each) for each in MEASUREMENTS["r1"]]
    plain, node = robot()
    wanted = given(plain, node, *measurements, (ch.END, "", END))
    assert plain.refused == 0, plain.last_refused
    boundary, node = robot()
    out = given(boundary, node, *measurements[:8])
    odometry = next(each for each in MEASUREMENTS["r1"][8:] if isinstance(each, m.Odometry))
    far = msgspec.structs.replace(odometry, stamp_ns=odometry.stamp_ns + 2 * LATE_NS)
    acknowledged = build.progress(node="central", submaps=10**6)
    attacks = [
        (ch.START, build.initial_pose(incarnation=HUGE), f"of incarnation {HUGE}"),
        (ch.START, build.initial_pose(incarnation=100), "of incarnation 100, while 1 is in"),
        (ch.ODOMETRY, msgspec.structs.replace(odometry, number=HUGE), f"counts to {HUGE}"),
        (ch.ODOMETRY, far, "days after its stream began"),
        (ch.CENTRAL_PROGRESS, acknowledged, "acknowledges 1000000 submaps of"),
        (ch.END, build.end(), "an end that omits r1"),
        (ch.END, build.end(r1=2), "ends with measurement 2 of r1"),
    ]
    for count, (channel, message, why) in enumerate(attacks, 1):
        out += given(boundary, node, (channel, "r1", message))
        assert (boundary.refused, why in boundary.last_refused) == (count, True), why
    reply = encoded(msgspec.structs.replace(odometry, robot="r2"))
    with pytest.raises(WireError, match="of 'r2' is no reply to 'source/r1/readings'"):
        read_reply(ch.MEASUREMENTS, "r1", reply, 0)
    out += given(boundary, node, *measurements[8:], (ch.END, "", END))
    sent, expected = ([*map(encoded, of(each, ch.SUBMAP))] for each in (out, wanted))
    assert sent == expected
    assert of(out, ch.ROBOT_DONE) == of(wanted, ch.ROBOT_DONE)


def world() -> tuple[Boundary, WorldNode]:
    announced = announce_configuration("world", 0, 0, RobotConfig("r1"))
    return Boundary("world"), WorldNode(world_of(*STREAMS.values()), frozenset(), announced)


def test_a_world_takes_no_credit_for_what_never_was_and_no_end_before_its_own():
    boundary, node = world()
    final = (ch.FINAL_MAP, "", example(m.FusedMap, final=True))
    recorded = build.progress(node="recorder", incarnation=7, measurements=1, submaps=1)
    assert node.publish(0.0)
    node.ended = False
    for channel, name, message, why in (
        (ch.ROBOT_PROGRESS, "r1", progress("r1", 10**6, 1), "consumed 1000000 of"),
        (ch.ROBOT_PROGRESS, "r9", progress("r9", 1, 1), "of r9, not in this team"),
        (ch.RECORDER_PROGRESS, "r1", recorded, "incarnation 7"),
        (*final, "before the end"),
    ):
        before = boundary.refused
        assert given(boundary, node, (channel, name, message)) == []
        assert (boundary.refused, why in boundary.last_refused) == (before + 1, True), why
    assert not node.finished
    node.ended = True
    given(boundary, node, final)
    assert node.finished


@pytest.mark.parametrize("order", [1, -1])
def test_what_a_team_can_say_is_refused_in_no_order(order):
    door = Door(["r1", "r2"])
    said = [message for _, _, message in run()]
    assert [door.refusal(message) for message in said[::order]] == [None] * len(said)
    assert door.refusal(build.done(incarnation=MOST_LIVES, measurements=MOST_COUNT)) is None
    assert door.refusal(build.done(incarnation=MOST_LIVES + 1)) is not None


def test_an_end_against_anybodys_word_is_believed_when_all_robots_are_done_there():
    (*said, end) = run()
    done = [each for each in said if each[0] == ch.ROBOT_DONE]
    before = [each for each in said if each[0] != ch.ROBOT_DONE]
    boundary, misled = centre()
    forged = (ch.ROBOT_PROGRESS, "r1", progress("r1", 1000, len(SUBMAPS["r1"])))
    given(boundary, misled, *before, forged, end)
    assert boundary.refused == 1
    assert misled.final is None
    given(boundary, misled, *done)
    assert_final_of(misled, *before, end, *done)


def assert_final_of(misled: CentralNode, *said: tuple[ch.Channel, str, m.Message]) -> None:
    """Check that it has the final map of a centre that received these messages alone."""
    boundary, honest = centre()
    given(boundary, honest, *said)
    assert honest.final is not None
    assert misled.final is not None
    assert encoded(misled.final) == encoded(honest.final)


def done_of(robot: str, incarnation: int, measurements: int, submaps: int) -> m.Done:
    life = {"robot": robot, "incarnation": incarnation}
    return build.done(**life, measurements=measurements, submaps=submaps)


def end_of(robot: str, incarnation: int, measurements: int) -> m.End:
    other = next(each for each in END.streams if each.robot != robot)
    mine = m.StreamEnd(robot=robot, incarnation=incarnation, measurements=measurements)
    return m.End(stamp_ns=0, streams=(mine, other))


FORGED: dict[str, list[tuple[ch.Channel, str, m.Message]]] = {
    "last words of a later incarnation": [(ch.ROBOT_DONE, "r1", done_of("r1", 900, 5, 0))],
    "last words of submaps that never were": [(ch.ROBOT_DONE, "r1", done_of("r1", 1, 5, 9))],
    "an end in a later incarnation": [(ch.END, "", end_of("r1", 900, 5))],
    "an end behind the true one": [(ch.END, "", end_of("r1", 1, 5000))],
    "progress, ends and last words": [
        (ch.ROBOT_PROGRESS, "r1", progress("r1", 1000, 50)),
        *((ch.END, "", end_of("r2", 3, 70 + n)) for n in range(20)),
        *((ch.ROBOT_DONE, "r2", done_of("r2", 3, 50 + n, 3)) for n in range(20)),
    ],
}


@pytest.mark.parametrize("behind", [False, True])
@pytest.mark.parametrize("what", FORGED)
def test_no_word_of_a_stranger_on_how_far_a_team_is_keeps_it_from_its_end(what, behind):
    (*said, end) = run()
    forged = FORGED[what]
    boundary, misled = centre()
    given(boundary, misled, *([*said, *forged] if behind else [*forged, *said]), end)
    assert_final_of(misled, *said, end)


def test_a_stranger_who_begins_a_stream_at_another_time_does_not_shut_its_source_out():
    boundary, node = centre()
    given(boundary, node, (ch.START, "r1", build.initial_pose(stamp_ns=2**61)), *run())
    assert node.final is not None
    assert boundary.refused == 0


def test_a_world_goes_on_when_others_took_what_a_stranger_has_published():
    boundary, node = world()
    given(boundary, node, (ch.ALIVE, "recorder", build.liveliness(node="recorder")))
    while node.publish(0.0):
        pass
    published = len(MEASUREMENTS["r1"]) + len(MEASUREMENTS["r2"])
    assert node.unrecorded == published
    for robot in STREAMS:
        far = msgspec.structs.replace(progress(robot, 5000, 1), node="recorder")
        given(boundary, node, (ch.RECORDER_PROGRESS, robot, far))
    assert (boundary.refused, node.unrecorded) == (2, 0)
    given(boundary, node, (ch.ROBOT_PROGRESS, "r1", progress("r1", 5000, 1)))
    assert node._sources["r1"].consumed == len(MEASUREMENTS["r1"])
