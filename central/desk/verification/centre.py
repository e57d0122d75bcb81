"""The centre's messages again: each recorded map from the inputs that it names.

The rule is the centre's own, and so is its function of the inputs (`central.rule`): what a rule
knew beyond them when it spoke (`unnamed`) is taken from the recorded map.
"""

from collections.abc import Iterator, Sequence

import msgspec

from central.desk.verification.recorded import Identity, Recorded, Stream, identity
from central.rule import FusionRule, Inputs, Tail, rule_of
from team.pairs import RULES, Channel
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import Outgoing


def retold_centre(log: Recorded) -> dict[Identity, m.Message]:
    """What the inputs that the recorded maps name give, under the names of these inputs."""
    finals = [f for f in log.of(ch.FINAL_MAP) if isinstance(f, m.FusedMap)]
    maps = [f for f in log.of(ch.FUSED_MAP) if isinstance(f, m.FusedMap)]
    found: dict[Identity, m.Message] = {}
    for out in _retold(log, maps, finals):
        found.setdefault(identity(out.key, out.message), out.message)
    return found


_OF_A_PEER = {
    ch.FUSED_MAP.name: ch.TEAM_MAP,
    ch.PRIOR.name: ch.TEAM_PRIOR,
    ch.FINAL_MAP.name: ch.TEAM_FINAL,
    ch.TRAJECTORY.name: ch.TEAM_TRAJECTORY,
}


def retold_peer(log: Recorded, robot: str) -> dict[Identity, m.Message]:
    """As `retold_centre`, of a peer's own fold: by the same rule from the same submaps."""

    def said(channel: ch.Channel) -> list[m.FusedMap]:
        key = channel.key(robot)
        own = (each.message for each in log.said if each.sample.key == key)
        return [each for each in own if isinstance(each, m.FusedMap)]

    found: dict[Identity, m.Message] = {}
    for out in _retold(log, said(ch.TEAM_MAP), said(ch.TEAM_FINAL)):
        if out.channel.name in _OF_A_PEER and out.name in ("", robot):
            key = _OF_A_PEER[out.channel.name].key(robot)
            found.setdefault(identity(key, out.message), out.message)
    return found


def _retold(
    log: Recorded, maps: Sequence[m.FusedMap], finals: Sequence[m.FusedMap]
) -> Iterator[Outgoing]:
    """What the inputs that maps name give, in the order of the inputs."""
    if not maps and not finals:
        return
    config, digest = log.central_config()
    announced = {n.removeprefix("robot/") for n in log.configured if n.startswith("robot/")}
    rule = rule_of(config, digest, sorted(announced.union(log.robots)))
    inputs = _LogInputs(log, RULES[config.fusion].consumes)
    lost = finals[-1].lost if finals else ()
    for fused in (*sorted(maps, key=lambda f: f.exchange), *finals):
        named = inputs.of(fused)
        for out in [] if named is None else rule.fuse(named, _tail(fused)):
            message = _as_known(out.message, fused, rule)
            if lost and isinstance(message, m.FusedMap) and message.final:  # no input says it
                message = msgspec.structs.replace(message, provisional=True, lost=lost)
            yield Outgoing(out.channel, out.name, message)


def _tail(fused: m.FusedMap) -> Tail:
    return "final" if fused.final else "provisional" if fused.provisional else "closed"


def _as_known(message: m.Message, fused: m.FusedMap, rule: FusionRule) -> m.Message:
    """With what the centre knew beyond the inputs when it said `fused`."""
    if isinstance(message, m.FusedMap | m.Prior):
        fields = set(rule.unnamed) & set(message.__struct_fields__)
        return msgspec.structs.replace(message, **{name: getattr(fused, name) for name in fields})
    return message


def _order(robot: str) -> m.Withdrawal:
    """What a peer's fold has found by itself, and says nowhere but in its maps."""
    return m.Withdrawal(stamp_ns=0, robot=robot, by="central", reason="")


class _LogInputs:
    """The inputs that a map names, out of a log."""

    def __init__(self, log: Recorded, consumed: Channel) -> None:
        self._log, self._consumed = log, consumed
        self._submaps, self._sightings = log.submaps(), log.sightings()
        starts = {stream: measurements.get(0) for stream, measurements in log.measurements.items()}
        self._starts = {s: start for s, start in starts.items() if isinstance(start, m.InitialPose)}
        own = (x for x in log.of(ch.OWN_MAP) if isinstance(x, m.MapEstimate))
        self._maps = {(x.robot, x.incarnation, x.sequence, x.exchange): x for x in own}

    def of(self, fused: m.FusedMap) -> Inputs | None:
        """None where the log lacks a submap of the map's version vector."""
        vector = {(x.robot, x.incarnation): x.sequence for x in fused.members}
        if self._consumed == "measurements":
            return Inputs(starts=self._starts, heard=tuple(self._heard()))
        if self._consumed == "own/map":
            named = ((*stream, k, fused.exchange) for stream, k in vector.items())
            maps = [self._maps[name] for name in named if name in self._maps]
            return Inputs(maps=maps, exchange=fused.exchange, stamp_ns=fused.stamp_ns)
        chains: dict[Stream, list[m.Submap]] = {}
        for stream, last in vector.items():
            found = self._submaps.get(stream, {})
            if not all(k in found for k in range(last + 1)):
                return None
            chains[stream] = [found[k] for k in range(last + 1)]
        orders = self._log.withdrawals
        return Inputs(
            starts=self._starts,
            submaps=chains,
            sightings=self._sightings,
            withdrawals={r: orders.get(r) or _order(r) for r in fused.withdrawn},
            verdicts=fused.verdicts,
            stamp_ns=fused.stamp_ns,
        )

    def _heard(self) -> Iterator[m.Message]:
        """The robots' models, every measurement by stream and counter, the end of the streams."""
        log = self._log
        for node in sorted(log.configured):
            if node.startswith("robot/"):
                yield log.configured[node]
        for stream in sorted(log.measurements):
            measurements = log.measurements[stream]
            yield from (measurements[counter] for counter in sorted(measurements))
        ends = tuple(
            m.StreamEnd(robot=robot, incarnation=incarnation, measurements=count)
            for (robot, incarnation), count in log.published.items()
        )
        if ends:
            yield m.End(stamp_ns=0, streams=ends)
