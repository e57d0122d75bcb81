"""Recomputes the centre's messages: each recorded map from the inputs that it names.

The rule is the centre's own (`central.rule`); rules whose maps depend on earlier maps use the
centre's scheduler, too. Fields that depend on more than the named inputs (`unnamed`) are taken from
the recorded map.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import msgspec

from central.attendance import TeamAttendance
from central.desk.verification.recorded import Identity, Recorded, identity
from central.intake import Inputs, MapInputs
from central.rule import FusionRule, Tail, rule_of
from central.scheduler import Scheduler
from central.submap_intake import SubmapInputs
from central.submap_set import SubmapSet
from central.unnamed_landmarks import verdict_of
from team.estimation.contribution import Stream
from team.pairs import RULES, Channel
from team.wire import channels as ch
from team.wire import messages as m
from team.wire.bus import Outgoing


def recomputed_centre(log: Recorded) -> dict[Identity, m.Message]:
    """The messages that follow from the inputs of the recorded maps, by the names of these
    inputs.
    """
    finals = [f for f in log.of(ch.FINAL_MAP) if isinstance(f, m.FusedMap)]
    maps = [f for f in log.of(ch.FUSED_MAP) if isinstance(f, m.FusedMap)]
    found: dict[Identity, m.Message] = {}
    for out in _recomputed(log, maps, finals):
        found.setdefault(identity(out.key, out.message), out.message)
    return found


_OF_A_PEER = {
    ch.FUSED_MAP.name: ch.TEAM_MAP,
    ch.PRIOR.name: ch.TEAM_PRIOR,
    ch.FINAL_MAP.name: ch.TEAM_FINAL,
    ch.TRAJECTORY.name: ch.TEAM_TRAJECTORY,
}


def recomputed_peer(log: Recorded, robot: str) -> dict[Identity, m.Message]:
    """The messages of a peer's own fold, by the same rule from the same submaps."""

    def maps_on(channel: ch.Channel) -> list[m.FusedMap]:
        key = channel.key(robot)
        own = (each.message for each in log.outputs if each.sample.key == key)
        return [each for each in own if isinstance(each, m.FusedMap)]

    found: dict[Identity, m.Message] = {}
    for out in _recomputed(log, maps_on(ch.TEAM_MAP), maps_on(ch.TEAM_FINAL)):
        if out.channel.name in _OF_A_PEER and out.name in ("", robot):
            key = _OF_A_PEER[out.channel.name].key(robot)
            found.setdefault(identity(key, out.message), out.message)
    return found


def _recomputed(
    log: Recorded, maps: Sequence[m.FusedMap], finals: Sequence[m.FusedMap]
) -> Iterator[Outgoing]:
    """The messages that follow from the inputs of these maps, in the order of the inputs."""
    if not maps and not finals:
        return
    config, digest = log.central_config()
    announced = {n.removeprefix("robot/") for n in log.configured if n.startswith("robot/")}
    rule = rule_of(config, digest, sorted(announced.union(log.robots)))
    if RULES[config.fusion].consumes == "measurements":
        yield from _from_measurements(log, Scheduler(rule))
        return
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


def _as_known(message: m.Message, fused: m.FusedMap, rule: FusionRule[Any]) -> m.Message:
    """The message with the fields of `fused` that depend on more than the named inputs."""
    if isinstance(message, m.FusedMap | m.Prior):
        fields = set(rule.unnamed) & set(message.__struct_fields__)
        return msgspec.structs.replace(message, **{name: getattr(fused, name) for name in fields})
    return message


def _from_measurements(log: Recorded, scheduler: Scheduler) -> Iterator[Outgoing]:
    """The messages of a rule on raw measurements, from the whole stream, since each map changes the
    next.
    """
    for message in _inputs_in_order(log):
        scheduler.intake.take(message, 0)
    yield from scheduler.advance(TeamAttendance.of(scheduler.rule.team))
    if log.published:
        yield from scheduler.conclude(0)


def _inputs_in_order(log: Recorded) -> Iterator[m.Message]:
    """The robots' models, every measurement by stream and counter, the end of the streams."""
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


class _LogInputs:
    """Collects from a log the inputs that a map names."""

    def __init__(self, log: Recorded, consumed: Channel) -> None:
        self._consumed = consumed
        self._set = SubmapSet()
        sightings = log.sightings()
        for stream, submaps in log.submaps().items():
            for sequence in sorted(submaps):
                self._set.admit(submaps[sequence])
                for each in sightings.get((*stream, sequence), ()):
                    self._set.admit_sighting(each)
        starts = {stream: measurements.get(0) for stream, measurements in log.measurements.items()}
        self._starts = {s: start for s, start in starts.items() if isinstance(start, m.InitialPose)}
        self._priors_of: dict[bytes, set[Stream]] = {}
        for prior in (*log.of(ch.PRIOR), *log.of(ch.TEAM_PRIOR)):
            if isinstance(prior, m.Prior):
                stream = (prior.robot, prior.incarnation)
                self._priors_of.setdefault(prior.digest, set()).add(stream)
        own = (x for x in log.of(ch.OWN_MAP) if isinstance(x, m.MapEstimate))
        self._maps = {(x.robot, x.incarnation, x.sequence, x.exchange): x for x in own}

    def of(self, fused: m.FusedMap) -> Inputs | None:
        """The inputs of a map; None where the log lacks a submap of its version vector, or its
        initial pose or factors.
        """
        vector = {(x.robot, x.incarnation): x.sequence for x in fused.members}
        if self._consumed == "own/map":
            named = ((*stream, k, fused.exchange) for stream, k in vector.items())
            maps = [self._maps[name] for name in named if name in self._maps]
            return MapInputs(
                recorded=True,
                maps=maps,
                starts=self._starts,
                exchange=fused.exchange,
                now_ns=fused.stamp_ns,
            )
        chains = {stream: self._set.chain(stream)[: last + 1] for stream, last in vector.items()}
        if any(
            len(chains[stream]) <= last or stream not in self._starts
            for stream, last in vector.items()
        ):
            return None
        return SubmapInputs(
            recorded=True,
            starts=self._starts,
            submaps=chains,
            sightings=self._set.sightings,
            withdrawn=fused.withdrawn,
            verdicts={verdict_of(each) for each in fused.verdicts},
            missing=fused.missing,
            arrived=fused.heard,
            priors_of=self._priors_of.get(fused.digest, set()),
            now_ns=fused.stamp_ns,
        )
