"""Hostile messages, and sessions of nodes that receive them, from a seeded generator.

`Team` and `hostile_stream` draw valid sessions: singular covariances, jumping clocks, coordinates
of 1e200 m. `extreme_samples` draws fields at the bounds of their types, `mutated` changes bytes.
"""

from collections.abc import Iterator, Mapping, Sequence
from random import Random
from typing import Any

import msgspec
import numpy as np

from teamslam.central.config import CentralConfig
from teamslam.central.node import CentralNode
from teamslam.team.config import RobotConfig
from teamslam.team.robot.node import RobotNode, robot_node
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.arrays import from_floats, from_ids, from_stamps
from teamslam.team.wire.bus import Outgoing
from teamslam.team.wire.codec import WireError, decoded, encoded
from tests import build
from tests.support import examples

S = 1_000_000_000
CONFIG = bytes(8)
SCALES = (0.0, 1e-300, 1e-12, 1e-6, 1e-3, 1.0, 1.0, 1.0, 30.0, 1e3, 1e6, 1e9, 1e15, 1e200)
SIGMAS = (1e-150, 1e-30, 1e-9, 1e-6, 1e-3, 0.1, 0.1, 0.1, 1.0, 30.0, 1e3, 1e6, 1e12, 1e140)
ROBOTS = ("r1", "r2", "r3")
PAIR = ("r1", "r2")  # the robots of the scenario that real processes run
OF_THE_RUN = (
    m.FusedMap, m.End, m.Done, m.Withdrawal, m.WithdrawalHeard, m.GivenUp, m.TeamEnd, m.StreamHead,
    m.Fault,
)  # fmt: skip
"""Messages that only keys keep from a stranger: they end a run, delay it, or report faults."""
SKIPPED = (*ch.QUERIES, ch.VIEW, ch.ALIVE)
CHANNELS = {
    kind: [row for row in ch.CHANNELS if row not in SKIPPED and kind in row.kinds]
    for kind in m.BY_TAG.values()
}
"""The channels that carry a message type; a request or a reply has none."""


def valid(message: m.Message) -> m.Message | None:
    try:
        return decoded(encoded(message), type(message))
    except (WireError, OverflowError):
        return None


def covariance(rng: np.random.Generator, n: int) -> np.ndarray:
    mild = rng.random() < 0.5
    sigmas = (
        np.full(n, 0.1) if mild else rng.choice(SIGMAS, n if rng.random() < 0.3 else 1) * np.ones(n)
    )
    kind = rng.integers(4)
    if kind == 0:
        correlation = np.eye(n)
    elif kind == 1:  # fully correlated, but for a little
        v = rng.choice([-1.0, 1.0], n)[:, None]
        left = 10.0 ** rng.uniform(-16.0, -1.0)
        correlation = (1.0 - left) * (v @ v.T) + left * np.eye(n)
    else:  # rank-deficient, but for a little
        A = rng.normal(size=(n, max(1, n - int(rng.integers(0, 3)))))
        raw = A @ A.T + 10.0 ** rng.uniform(-15.0, 0.0) * np.eye(n)
        d = np.sqrt(np.diag(raw))
        correlation = raw / d / d[:, None]
    P = correlation * sigmas * sigmas[:, None]
    return 0.5 * (P + P.T)


def numbers(rng: np.random.Generator, n: int) -> np.ndarray:
    if rng.random() < 0.6:
        return rng.uniform(-20.0, 20.0, n)
    if rng.random() < 0.3:
        return np.full(n, rng.choice(SCALES))
    return rng.normal(size=n) * rng.choice(SCALES, n)


def packed(P: np.ndarray) -> bytes:
    return from_floats(P[np.triu_indices(len(P))])


class Team:
    """A hostile team: chains of submaps that continue, so that a set accepts them.

    In every third team landmarks lack identities, and an operator gives verdicts.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._unnamed = int(rng.integers(3)) == 0
        self._next = dict.fromkeys(ROBOTS, 0)
        self.messages: list[m.Message] = []
        for robot in ROBOTS:
            self._add(self.start(robot))

    def _add(self, message: m.Message) -> bool:
        found = valid(message)
        if found is not None:
            self.messages.append(found)
        return found is not None

    def start(self, robot: str) -> m.InitialPose:
        rng = self._rng
        unknown = build.initial_pose(robot=robot)
        if rng.random() < 0.5:
            return unknown
        pose = from_floats(np.append(numbers(rng, 2), rng.uniform(-3.0, 3.0)))
        spread = b"" if rng.random() < 0.5 else from_floats(covariance(rng, 3))
        drawn = msgspec.structs.replace(unknown, pose=pose, covariance=spread)
        return drawn if valid(drawn) else msgspec.structs.replace(unknown, pose=pose)

    def submap(self, robot: str) -> m.Submap:
        rng, k = self._rng, self._next[robot]
        ids = np.unique(rng.integers(1, 8, int(rng.integers(0, 6)))).astype(np.uint32)
        if self._unnamed:
            ids = (2**31 + np.arange(len(ids))).astype(np.uint32)
        nodes = np.unique(rng.integers(1, 6, int(rng.integers(0, 3)))) * 2 * S + k * 10 * S
        n = 3 + 3 * len(nodes) + 2 * len(ids)
        mean = numbers(rng, n)
        if rng.random() < 0.3:  # a standing robot that sees all landmarks at one place
            mean[:] = 0.0
        poses = 3 * (1 + len(nodes))
        mean[2:poses:3] = np.clip(mean[2:poses:3], -3.1, 3.1)
        biases = ("bearing", "range_scale") if rng.random() < 0.2 else ()
        return build.submap(
            stamp_ns=(k + 1) * 10 * S,
            robot=robot,
            sequence=k,
            first_measurement=k * 20 + (k > 0),
            last_measurement=k * 20 + 20,
            start_ns=k * 10 * S,
            config=CONFIG,
            ids=ids,
            mean=mean,
            covariance=packed(covariance(rng, n)),
            nodes=nodes,
            biases=biases,
            sensitivity=numbers(rng, n * len(biases)),
        )

    def grow(self) -> None:
        rng = self._rng
        robot = str(rng.choice(ROBOTS))
        made = self.submap(robot)
        stamps = np.frombuffer(made.nodes, "<i8")
        seen = [self._sighting(made, int(t)) for t in stamps if rng.random() < 0.7]
        seen = [each for each in seen if valid(each) is not None]
        if self._add(msgspec.structs.replace(made, sightings=len(seen)) if seen else made):
            self._next[robot] += 1
            for each in seen:
                self._add(each)
        if self._unnamed and rng.random() < 0.3:
            self._add(self._verdict())

    def _verdict(self) -> m.Verdict:
        rng = self._rng
        first, second = (
            m.LocalLandmark(
                robot=str(rng.choice(ROBOTS)),
                incarnation=1,
                sequence=int(rng.integers(4)),
                local=int(rng.choice([0, 1, 2, 2**31 - 1], p=[0.4, 0.3, 0.2, 0.1])),
            )
            for _ in range(2)
        )
        return build.verdict(first, second, same=bool(rng.random() < 0.5))

    def _sighting(self, submap: m.Submap, stamp_ns: int) -> m.SightingFactor:
        rng = self._rng
        teammate = str(rng.choice([r for r in ROBOTS if r != submap.robot]))
        distance = float(abs(numbers(rng, 1)[0])) or 1.0
        return build.sighting_factor(
            stamp_ns=stamp_ns,
            robot=submap.robot,
            sequence=submap.sequence,
            config=CONFIG,
            teammate=teammate,
            range=distance,
            bearing=float(rng.uniform(-3.0, 3.0)),
            covariance=packed(covariance(rng, 2)),
            measurements=(stamp_ns // S,),
        )

    def ends(self) -> list[m.Message]:
        return last_words(self._next)


def last_words(submaps: Mapping[str, int]) -> list[m.Message]:
    out: list[m.Message] = []
    for robot, count in submaps.items():
        counts = {"robot": robot, "measurements": 1000, "submaps": count}
        at = {"stamp_ns": count * 10 * S}
        out += [build.progress(**at, **counts), build.done(**at, **counts, steps=500)]
    return [*out, build.end(10**12, **dict.fromkeys(ROBOTS, 1000))]


def centre_session(
    messages: Sequence[m.Message], config: CentralConfig | None = None
) -> tuple[CentralNode, list[Outgoing]]:
    """Run a centre on these messages; check that its own messages are valid."""
    centre = CentralNode(config or CentralConfig(), list(ROBOTS))
    out = centre.begin()
    for robot in ROBOTS:
        out += centre.handle(build.liveliness(node=f"robot/{robot}"))
    for message in messages:
        out += centre.handle(message)
    for each in [*out, Outgoing(out[0].channel, "central", centre.status())]:
        decoded(encoded(each.message), type(each.message))
    return centre, out


def _interval(
    rng: np.random.Generator, robot: str, number: int, start_ns: int, end_ns: int
) -> m.Measurement:
    speed = float(numbers(rng, 1)[0]) if rng.random() < 0.2 else 1.0
    turn = float(numbers(rng, 1)[0]) if rng.random() < 0.2 else 0.1
    name = {"stamp_ns": end_ns, "robot": robot, "incarnation": 1, "number": number}
    name["duration_ns"] = end_ns - start_ns
    match rng.integers(6):
        case 0:
            spread = b"" if rng.random() < 0.5 else from_floats(covariance(rng, 3))
            motion = from_floats([speed, float(numbers(rng, 1)[0]), np.clip(turn, -3.1, 3.1)])
            return build.increment(**name, increment=motion, covariance=spread)
        case 1:
            return m.Steering(**name, wheel_speed=speed, steering=float(np.clip(turn, -1.5, 1.5)))
        case _:
            return build.odometry(**name, forward=speed, yaw_rate=turn)


def _scan(rng: np.random.Generator, robot: str, number: int, stamp_ns: int) -> m.Measurement:
    n = int(rng.choice([0, 1, 2, 3, 6, 300], p=[0.1, 0.2, 0.3, 0.2, 0.18, 0.02]))
    ids = from_ids(rng.integers(1, 8 if n < 300 else 5000, n))
    ranges, bearings = np.abs(numbers(rng, n)), rng.uniform(-np.pi, np.pi, n)
    bearings *= rng.random() < 0.8
    spread = b""
    if rng.random() < 0.3:
        spread = b"".join(packed(covariance(rng, 2)) for _ in range(n))
    name = {"stamp_ns": stamp_ns, "robot": robot, "incarnation": 1, "number": number}
    polar = {"ranges": from_floats(ranges), "bearings": from_floats(bearings)}
    match rng.integers(6):
        case 0:
            places = from_floats(numbers(rng, 2 * n))
            return build.points(**name, ids=ids, positions=places, covariances=spread)
        case 1:
            alike = b"" if rng.random() < 0.5 else from_floats(numbers(rng, n))
            return build.detections(**name, **polar, covariances=spread, signatures=alike)
        case _:
            return build.observations(**name, ids=ids, **polar, covariances=spread)


def hostile_stream(rng: np.random.Generator, robot: str, count: int) -> Iterator[m.Message]:
    yield Team(rng).start(robot)
    now_ns = 0
    counter = 0
    while counter < count:
        kind = rng.integers(12)
        stamp_ns = now_ns
        if kind == 0:  # a clock that stands, goes back or leaps
            stamp_ns = now_ns + int(rng.choice([-3600, -1, 0, 3600, 10**7, 10**9])) * S
        end_ns = now_ns
        if kind <= 5:
            end_ns = stamp_ns + int(rng.choice([0, 1, S // 10, S, S, S, S, 3600 * S]))
            message = _interval(rng, robot, counter + 1, stamp_ns, end_ns)
        elif kind <= 10:
            message = _scan(rng, robot, counter + 1, stamp_ns)
        else:
            names = tuple(str(x) for x in rng.choice(ROBOTS, int(rng.integers(0, 3))))
            message = build.sightings(
                stamp_ns=stamp_ns,
                robot=robot,
                number=counter + 1,
                teammates=names,
                ranges=np.abs(numbers(rng, len(names))),
                bearings=rng.uniform(-np.pi, np.pi, len(names)),
            )
        if valid(message) is not None:  # impossible messages of a driver have no number
            counter += 1
            yield message
            if 0 < kind <= 5:
                now_ns = end_ns
        if rng.random() < 0.05:
            yield prior(rng, robot)
    yield build.end(now_ns, **{robot: counter + 1})


def prior(rng: np.random.Generator, robot: str) -> m.Prior:
    ids = np.unique(rng.integers(1, 8, int(rng.integers(0, 5)))).astype(np.uint32)
    n = 3 + 2 * len(ids)
    sequence = int(rng.integers(-1, 4))
    return build.prior(
        stamp_ns=sequence * 10 * S,
        robot=robot,
        sequence=sequence,
        digest=CONFIG,
        ids=ids,
        mean=numbers(rng, n),
        covariance=packed(covariance(rng, n)),
    )


def robot_session(
    messages: Iterator[m.Message], config: RobotConfig
) -> tuple[RobotNode, list[Outgoing]]:
    """Run a robot on the valid ones of these messages; check that its own messages are valid."""
    node = robot_node(config)
    out = node.begin()
    for message in messages:
        found = valid(message)
        if found is None:
            continue
        out += node.handle(found)
        answers = [each.message for each in out if isinstance(each.message, m.Submap)]
        if answers:
            credit = build.progress(node="central", robot=node.robot, submaps=len(answers))
            out += node.handle(credit)
    for each in [*out, Outgoing(out[0].channel, "", node.status())]:
        decoded(encoded(each.message), type(each.message))
    return node, out


def payloads(rng: Random) -> Iterator[tuple[ch.Channel, str, bytes]]:
    """Hostile sessions and extreme messages of every type, each on its channels, endless."""
    while True:
        numbers = np.random.default_rng(rng.getrandbits(32))
        team = Team(numbers)
        for _ in range(20):
            team.grow()
        robot = rng.choice(PAIR)
        drawn = [*team.messages, *team.ends(), *hostile_stream(numbers, robot, 60)]
        drawn += [found for _ in range(10) if (found := valid(prior(numbers, robot)))]
        for message in drawn:
            for channel in CHANNELS.get(type(message), ()):
                name = getattr(message, "robot", getattr(message, "node", robot)) or robot
                yield channel, name if "{" in channel.template else "", encoded(message)
        for kind in CHANNELS:
            yield from extreme_samples(numbers, kind, 1)


def mutated(rng: Random, payload: bytes) -> bytes:
    data = bytearray(payload)
    for _ in range(rng.choice([1, 1, 1, 2, 5, 20])):
        if not data:
            break
        at = rng.randrange(len(data))
        match rng.randrange(6):
            case 0:
                data[at] ^= 1 << rng.randrange(8)
            case 1:
                data[at] = rng.choice([0, 0x7F, 0x80, 0xC0, 0xC1, 0xCF, 0xDD, 0xDF, 0xFF])
            case 2:
                del data[at:]
            case 3:
                del data[at : at + rng.randrange(1, 9)]
            case 4:
                data[at:at] = rng.randbytes(rng.randrange(1, 9))
            case _:
                data[at : at + 8] = rng.choice([b"\0" * 8, b"\xff" * 8, b"\0\0\0\0\0\0\xf8\x7f"])
    return bytes(data)


NUMBERS = (0, 1, 2, 7, 2**16, 2**31 - 1, 2**31, 2**32 - 2, 2**32 - 1)  # ids and counts: 32 bits
INTEGERS = (*NUMBERS, 2**40, 2**53, 2**62 - 1, 2**63 - 1, -1, -(2**62))
FLOATS = (0.0, -0.0, 1.0, -1.0, 5e-324, 1e-300, 1e-12, 3.2, 1e9, -1e9, 1e154, 1e300, -1e300)
ESCAPES = ("\x1b]0;owned\x07", "\x1b[2J", "\u202e\u2066")
TEXTS = ("", *ESCAPES, "r1", "robot/r1", "\0", "a" * 20_000, "<b>&")
NAMES = (*ROBOTS, "a", "z" * 32, "stranger_0")
WORDS = {"ids", "counts", "labels", "identities", "locals", "sequences", "rows", "landmarks"}
"""Fields of uint32."""
FLAWS = ("robot", "incarnation", "number", "node", "name")
"""A node decides by these fields whether to look at a message; they are rarely changed."""


def extreme(rng: np.random.Generator, message: m.Message) -> m.Message:
    rate = rng.choice([0.1, 0.3, 0.9])
    for name in rng.permutation(list(message.__struct_fields__)).tolist():
        if rng.random() > rate or (name in FLAWS and rng.random() < 0.7):
            continue
        changed = msgspec.structs.replace(
            message, **{name: _other(rng, name, getattr(message, name))}
        )
        try:
            message = valid(changed) or message
        except (TypeError, ValueError):
            continue
    return message


def _other(rng: np.random.Generator, name: str, value: Any) -> Any:
    match value:
        case bool():
            return not value
        case int() if rng.random() < 0.8:
            return int(rng.choice(INTEGERS))
        case int():
            return value + int(rng.integers(-2, 3))
        case float():
            return float(rng.choice(FLOATS))
        case str():
            return str(rng.choice(NAMES if rng.random() < 0.5 else TEXTS))
        case bytes():
            return _array(rng, name, value)
        case tuple():
            return _row(rng, name, value)
        case dict():
            return {str(key): float(rng.choice(FLOATS)) for key in rng.choice(TEXTS, 3)}
        case msgspec.Struct():
            chosen = str(rng.choice(value.__struct_fields__))
            other = _other(rng, chosen, getattr(value, chosen))
            return msgspec.structs.replace(value, **{chosen: other})
        case _:
            return value


def _array(rng: np.random.Generator, name: str, value: bytes) -> bytes:
    if name in WORDS:
        count = len(value) // 4
        return from_ids(np.sort(rng.choice(NUMBERS, count, replace=count > len(NUMBERS))))
    if name in ("stamps", "nodes"):
        return from_stamps(np.sort(rng.integers(-(2**62), 2**62, len(value) // 8)))
    if len(value) % 8 or rng.random() < 0.1:
        return rng.bytes(len(value))
    old = np.frombuffer(value, "<f8")
    with np.errstate(all="ignore"):
        scaled = old * rng.choice([0.0, 1e-150, 1e-9, 1e9, 1e150, -1.0])
    return from_floats(scaled if rng.random() < 0.6 else rng.choice(FLOATS, len(old)))


def _row(rng: np.random.Generator, name: str, value: tuple[Any, ...]) -> tuple[Any, ...]:
    if not value or rng.random() < 0.2:
        return ()
    some = [_other(rng, name, each) if rng.random() < 0.5 else each for each in value]
    return tuple(some * (500 if rng.random() < 0.1 else 1))


def extreme_samples(
    rng: np.random.Generator, kind: type[m.Message], count: int
) -> Iterator[tuple[ch.Channel, str, bytes]]:
    """Extreme messages of a class, `count` on each of its channels."""
    (example,) = (each for each in examples() if type(each) is kind)
    for _ in range(count):
        robot = str(rng.choice(ROBOTS))
        own: dict[str, object] = {"robot": robot} if "robot" in kind.__struct_fields__ else {}
        if "incarnation" in kind.__struct_fields__:
            own["incarnation"] = 1
        if "stamp_ns" in kind.__struct_fields__:
            own["stamp_ns"] = int(rng.integers(0, 100)) * S
        base = valid(msgspec.structs.replace(example, **own)) or example
        for channel in CHANNELS[kind]:
            name = (
                getattr(base, "robot", robot) if "{robot}" in channel.template else f"robot/{robot}"
            )
            publisher = channel.publisher(name if "{" in channel.template else "")
            if "node" in kind.__struct_fields__ and rng.random() < 0.7:
                base = valid(msgspec.structs.replace(base, node=publisher)) or base
            message = extreme(rng, base)
            name = getattr(message, "robot", name) if "{robot}" in channel.template else name
            yield channel, name if "{" in channel.template else "", encoded(message)
