"""The centre's messages again: each recorded map from the set that it names."""

from collections.abc import Callable, Iterator, Mapping

import msgspec

from central.baselines.feedback_rule import FeedbackRule
from central.baselines.map_rules import AloneRule, LatestRule
from central.baselines.svd_rule import SvdJoinRule
from central.config import CentralConfig
from central.desk.verification.recorded import Identity, Recorded, Stream, identity
from central.join_rule import JoinRule, Tail
from central.roll import Roll
from central.rule import rule_of
from team.config import FusionRule
from team.pairs import FEEDBACK
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import Outgoing


def retold_centre(log: Recorded) -> dict[Identity, m.Message]:
    """What the sets that the recorded maps name give, under the names of these inputs."""
    maps = [f for f in log.of(ch.FUSED_MAP) if isinstance(f, m.FusedMap)]
    finals = [f for f in log.of(ch.FINAL_MAP) if isinstance(f, m.FusedMap)]
    if not maps and not finals:
        return {}
    config, digest = log.central_config()
    retell = _exchanged if config.fusion in FEEDBACK else _RETOLD[config.fusion]
    found: dict[Identity, m.Message] = {}
    lost = finals[-1].lost if finals else ()
    for out in retell(log, config, digest, [*maps, *finals]):
        message = out.message
        if lost and isinstance(message, m.FusedMap) and message.final:  # the set does not say it
            message = msgspec.structs.replace(message, provisional=True, lost=lost)
        found.setdefault(identity(out.key, message), message)
    return found


def _joined(
    log: Recorded, config: CentralConfig, digest: bytes, maps: list[m.FusedMap]
) -> Iterator[Outgoing]:
    """Each map from its own version vector; a set that grows keeps the fold that there is.

    Which submaps lie behind a gap and how much it had heard is what the centre knew when it spoke:
    it says so in the map. So it does of who was withdrawn: nobody is judged again by a part of the
    set.
    """
    config = msgspec.structs.replace(config, withdraw_above=None)
    starts = {s: r.get(0) for s, r in log.readings.items()}
    submaps, sightings = log.submaps(), log.sightings()
    rule = JoinRule(config, digest)
    inside: dict[Stream, int] = {}
    gone: set[str] = set()
    for fused in maps:
        vector = {(x.robot, x.epoch): x.sequence for x in fused.members}
        if not _complete(vector, submaps):
            continue
        shrunk = any(vector.get(stream, -1) < sequence for stream, sequence in inside.items())
        if shrunk or not gone <= set(fused.withdrawn):
            rule, inside = JoinRule(config, digest), {}
        gone = set(fused.withdrawn)
        for robot in fused.withdrawn:
            if robot in log.withdrawals:
                rule.take_withdrawal(log.withdrawals[robot])
        for stream, sequence in sorted(vector.items()):
            start = starts.get(stream)
            if isinstance(start, m.Start):
                rule.take_start(start)
            for k in range(inside.get(stream, -1) + 1, sequence + 1):
                for sighting in sightings.get((*stream, k), ()):
                    rule.take_sighting(sighting)
                rule.take_submap(submaps[stream][k])
        inside = vector
        for out in rule.retold(_tail(fused)):
            yield Outgoing(out.channel, out.name, _as_known(out.message, fused))


def _as_known(message: m.Message, fused: m.FusedMap) -> m.Message:
    """With what the centre knew of the rest of the set when it said `fused`."""
    if isinstance(message, m.FusedMap):
        return msgspec.structs.replace(message, missing=fused.missing, heard=fused.heard)
    if isinstance(message, m.Prior):
        return msgspec.structs.replace(message, heard=fused.heard)
    return message


def _tail(fused: m.FusedMap) -> Tail:
    return "final" if fused.final else "provisional" if fused.provisional else "closed"


def _complete(
    vector: Mapping[Stream, int], submaps: Mapping[Stream, Mapping[int, m.Submap]]
) -> bool:
    return all(
        k in submaps.get(stream, {}) for stream, last in vector.items() for k in range(last + 1)
    )


def _exchanged(
    log: Recorded, config: CentralConfig, digest: bytes, maps: list[m.FusedMap]
) -> Iterator[Outgoing]:
    """Each round from the maps that it names; the rounds follow one another."""
    own = {
        (x.exchange, x.robot, x.epoch, x.sequence): x
        for x in log.of(ch.OWN_MAP)
        if isinstance(x, m.MapEstimate)
    }
    rule = FeedbackRule(config, digest)
    for fused in sorted(maps, key=lambda f: (f.final, f.exchange)):
        if fused.final:
            yield from rule.conclude(fused.stamp_ns)
            continue
        for member in fused.members:
            named = (fused.exchange, member.robot, member.epoch, member.sequence)
            if named in own:
                rule.take_map(own[named])
        yield from rule.advance(lambda _robot, _round: False, [])


def _latest(
    log: Recorded, config: CentralConfig, digest: bytes, maps: list[m.FusedMap]
) -> Iterator[Outgoing]:
    """Each map from the own maps that it names; who has no place was known when it was said."""
    own = _own_maps(log)
    for fused in maps:
        rule = LatestRule(config, digest)
        for out in rule.retold(_named(own, fused), final=fused.final):
            yield _with_reasons(out, fused)


def _alone(
    log: Recorded, config: CentralConfig, digest: bytes, maps: list[m.FusedMap]
) -> Iterator[Outgoing]:
    """The final map from the own maps that it names."""
    own = _own_maps(log)
    for fused in maps:
        rule = AloneRule(config, digest, log.robots)
        yield from rule.retold(_named(own, fused), fused.stamp_ns)


def _tied(
    log: Recorded, config: CentralConfig, digest: bytes, maps: list[m.FusedMap]
) -> Iterator[Outgoing]:
    """Each map from the submaps of its own version vector."""
    submaps = log.submaps()
    rule = SvdJoinRule(config, digest)
    for readings in log.readings.values():
        start = readings.get(0)
        if isinstance(start, m.Start):
            rule.take_start(start)
    for fused in maps:
        vector = {(x.robot, x.epoch): x.sequence for x in fused.members}
        if _complete(vector, submaps):
            chains = {s: [submaps[s][k] for k in range(n + 1)] for s, n in vector.items()}
            channel = ch.FINAL_MAP if fused.final else ch.FUSED_MAP
            yield Outgoing(channel, "", rule.retold_map(chains, final=fused.final))


def _heard(
    log: Recorded, config: CentralConfig, digest: bytes, maps: list[m.FusedMap]
) -> Iterator[Outgoing]:
    """Everything again from the raw readings and what the robots announced."""
    nodes = sorted(node for node in log.configured if node.startswith("robot/"))
    robots = [node.removeprefix("robot/") for node in nodes]
    rule, roll = rule_of(config, digest, robots), Roll.of(robots)
    ends = [m.StreamEnd(*stream, count) for stream, count in log.published.items()]
    streams = (log.readings[stream] for stream in sorted(log.readings))
    for message in (
        *(log.configured[node] for node in nodes),
        *(stream[counter] for stream in streams for counter in sorted(stream)),
        *([m.End(0, tuple(ends))] if ends else []),
    ):
        rule.take(message, 0)
    yield from rule.advance(roll)
    if ends:
        yield from rule.conclude(0)


Named = tuple[str, int, int]
"""(robot, epoch, sequence)."""


def _own_maps(log: Recorded) -> dict[Named, m.MapEstimate]:
    said = (x for x in log.of(ch.OWN_MAP) if isinstance(x, m.MapEstimate))
    return {(x.robot, x.epoch, x.sequence): x for x in said}


def _named(own: Mapping[Named, m.MapEstimate], fused: m.FusedMap) -> list[m.MapEstimate]:
    names = [(x.robot, x.epoch, x.sequence) for x in fused.members]
    return [own[name] for name in names if name in own]


def _with_reasons(out: Outgoing, fused: m.FusedMap) -> Outgoing:
    again = out.message
    assert isinstance(again, m.FusedMap)
    return Outgoing(out.channel, out.name, msgspec.structs.replace(again, reasons=fused.reasons))


Retell = Callable[[Recorded, CentralConfig, bytes, list[m.FusedMap]], Iterator[Outgoing]]
_RETOLD: Mapping[FusionRule, Retell] = {
    "join": _joined,
    "latest": _latest,
    "alone": _alone,
    "svd-join": _tied,
    "svd-join-spherical": _tied,
    "joint-fastslam": _heard,
    "batch": _heard,
}
