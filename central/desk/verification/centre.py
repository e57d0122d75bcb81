"""The centre's messages again: each recorded map from the inputs that it names.

The rule is the centre's own, and so is its function of the inputs (`central.rule`): what a rule
knew beyond them when it spoke (`unnamed`) is taken from the recorded map.
"""

from collections.abc import Iterator

import msgspec

from central.desk.verification.recorded import Identity, Recorded, Stream, identity
from central.rule import FusionRule, Inputs, Tail, rule_of
from team.pairs import CONSUMES, Channel
from team.wire import channels as ch
from team.wire import messages as m


def retold_centre(log: Recorded) -> dict[Identity, m.Message]:
    """What the inputs that the recorded maps name give, under the names of these inputs."""
    finals = [f for f in log.of(ch.FINAL_MAP) if isinstance(f, m.FusedMap)]
    maps = [f for f in log.of(ch.FUSED_MAP) if isinstance(f, m.FusedMap)]
    if not maps and not finals:
        return {}
    config, digest = log.central_config()
    announced = {n.removeprefix("robot/") for n in log.configured if n.startswith("robot/")}
    rule = rule_of(config, digest, sorted(announced.union(log.robots)))
    inputs = _LogInputs(log, CONSUMES[config.fusion])
    lost = finals[-1].lost if finals else ()
    found: dict[Identity, m.Message] = {}
    for fused in (*sorted(maps, key=lambda f: f.exchange), *finals):
        named = inputs.of(fused)
        for out in [] if named is None else rule.fuse(named, _tail(fused)):
            message = _as_known(out.message, fused, rule)
            if lost and isinstance(message, m.FusedMap) and message.final:  # no input says it
                message = msgspec.structs.replace(message, provisional=True, lost=lost)
            found.setdefault(identity(out.key, message), message)
    return found


def _tail(fused: m.FusedMap) -> Tail:
    return "final" if fused.final else "provisional" if fused.provisional else "closed"


def _as_known(message: m.Message, fused: m.FusedMap, rule: FusionRule) -> m.Message:
    """With what the centre knew beyond the inputs when it said `fused`."""
    if isinstance(message, m.FusedMap | m.Prior):
        fields = set(rule.unnamed) & set(message.__struct_fields__)
        return msgspec.structs.replace(message, **{name: getattr(fused, name) for name in fields})
    return message


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
            withdrawals={r: orders[r] for r in fused.withdrawn if r in orders},
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
