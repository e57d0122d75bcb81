"""Sets of small members, and peers with reordering, loss, duplicates and partitions."""

import random
from collections.abc import Iterator, Sequence
from functools import cache

import msgspec

from teamslam.team.peers.members import Member, about
from teamslam.team.peers.node import PeerNode
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Outgoing
from teamslam.team.wire.codec import decoded, encoded
from tests import build
from tests.support import packed, spd, submap

PACKED = packed(spd(2))


def member(channel: ch.Channel, message: m.Message) -> Member:
    return Member(channel.key(about(message)), encoded(message), message)


def start(robot: str, incarnation: int = 1) -> Member:
    pose = build.initial_pose(robot=robot, incarnation=incarnation, pose=[0.0, 0.0, 0.0])
    return member(ch.START, pose)


def parcel(robot: str, sequence: int, mates: Sequence[str] = ()) -> list[Member]:
    own = msgspec.structs.replace(submap(sequence, robot, 1), incarnation=1, sightings=len(mates))
    factors = [
        build.sighting_factor(
            stamp_ns=own.stamp_ns,
            robot=robot,
            sequence=sequence,
            config=own.config,
            teammate=mate,
            range=1.0,
            bearing=0.0,
            covariance=PACKED,
            measurements=(own.first_measurement,),
        )
        for mate in mates
    ]
    return [*(member(ch.SIGHTING_FACTOR, each) for each in factors), member(ch.SUBMAP, own)]


def done(robot: str, submaps: int) -> Member:
    last = build.done(
        stamp_ns=submaps * 1_000_000, robot=robot, measurements=10 * submaps, submaps=submaps
    )
    return member(ch.ROBOT_DONE, last)


@cache
def said(robot: str, submaps: int, mate: str) -> tuple[list[Member], ...]:
    parcels = [parcel(robot, k, [mate] if k % 3 == 1 else []) for k in range(submaps)]
    return ([start(robot)], *parcels, [done(robot, submaps)])


class Storm:
    def __init__(self, seed: int, robots: int = 3, submaps: int = 4) -> None:
        self.rng = random.Random(seed)
        self.names = [f"r{i + 1}" for i in range(robots)]
        self.nodes = {name: self.node(name) for name in self.names}
        ring = zip(self.names, [*self.names[1:], self.names[0]], strict=True)
        self.lives = {name: list(said(name, submaps, mate)) for name, mate in ring}
        self.disk: dict[str, list[Member]] = {name: [] for name in self.names}
        self.way: list[tuple[str, str, object]] = []
        self.cut: set[frozenset[str]] = set()
        self.now_s = 0.0

    def node(self, name: str) -> PeerNode:
        return PeerNode(ch.robot_node(name), self.names)

    def run(self, turns: int = 10) -> None:
        """Take random turns; then connect all in a chain until no message is left."""
        for _ in range(turns):
            self.turn()
        self.cut = {
            frozenset((a, b))
            for i, a in enumerate(self.names)
            for j, b in enumerate(self.names)
            if abs(i - j) > 1
        }
        for name in self.names:
            while self.lives[name]:
                self.say(name)
        for _ in range(60):
            self.now_s += 1.0
            self.talk()
            if len({self.digest(name) for name in self.names}) == 1 and not self.way:
                return

    def digest(self, name: str) -> bytes:
        return self.nodes[name].replica.digest

    def turn(self) -> None:
        self.now_s += 1.0
        if self.rng.random() < 0.3:
            pairs = [frozenset((a, b)) for a in self.names for b in self.names if a < b]
            self.cut = set(self.rng.sample(pairs, self.rng.randrange(len(pairs) + 1)))
        name = self.rng.choice(self.names)
        if self.lives[name]:
            self.say(name)
        if self.rng.random() < 0.1:
            self.kill(self.rng.choice(self.names))
        self.talk(loss=0.2, late=0.3, twice=0.1)

    def say(self, name: str) -> None:
        members = self.lives[name].pop(0)
        members = self.rng.sample(members, len(members))
        for each in members:
            self.keep(name, each, name)
            for other in self.names:
                self.send(name, other, each)

    def keep(self, name: str, each: Member, carrier: str) -> None:
        if self.nodes[name].take(each, carrier):
            self.disk[name].append(each)

    def kill(self, name: str) -> None:
        kept = self.disk[name]
        own = [each for each in kept if about(each.message) == name]
        rest = [each for each in kept if about(each.message) != name]
        self.disk[name] = own + rest[: len(rest) - self.rng.randrange(3)]
        self.nodes[name] = self.node(name)
        for each in self.disk[name]:
            self.nodes[name].take(each, name)

    def send(self, sender: str, to: str, what: object) -> None:
        if sender != to and frozenset((sender, to)) not in self.cut:
            self.way.append((sender, to, what))

    def talk(self, loss: float = 0.0, late: float = 0.0, twice: float = 0.0) -> None:
        for name, node in self.nodes.items():
            self.spread(name, node.tick(self.now_s))
        rounds = 0
        while self.way and rounds < 20:
            rounds += 1
            going, self.way = self.way, []
            self.rng.shuffle(going)
            for sender, to, what in going:
                if self.rng.random() < loss:
                    continue
                if self.rng.random() < late:
                    self.way.append((sender, to, what))
                    continue
                for _ in range(2 if self.rng.random() < twice else 1):
                    self.arrive(sender, to, what)
            if late:
                return

    def arrive(self, sender: str, to: str, what: object) -> None:
        node = self.nodes[to]
        match what:
            case Member():
                self.keep(to, what, ch.robot_node(sender))
            case m.SetSummary():
                self.spread(to, node.take_summary(what))
            case m.MembersRequest():
                for reply in node.answer(encoded(what)):
                    self.send(to, sender, decoded(reply, m.Members))
            case m.Members():
                self.disk[to] += node.take_carried(what)
                self.spread(to, node.request_rest(what.node))

    def spread(self, name: str, out: Sequence[Outgoing]) -> None:
        for each in out:
            to = [ch.robot_of(each.name)] if each.channel is ch.MEMBERS else self.names
            for other in to:
                assert other is not None
                self.send(name, other, each.message)

    def fed(self, name: str) -> Iterator[m.Message]:
        self.nodes[name].restart_fold()
        return self.nodes[name].new_messages()
