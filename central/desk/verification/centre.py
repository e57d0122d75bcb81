"""Recompute the centre's messages: each recorded map from the inputs that it names.

Centres of comparison methods recompute their own maps. Fields without a named input are copied.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import msgspec

from teamslam.central.desk.verification.recorded import Identity, Recorded, RerunError, identity
from teamslam.central.join_messages import Tail
from teamslam.central.node import node_class
from teamslam.central.submap_fold import RecordedFields, SubmapFold
from teamslam.team.pairs import RULES
from teamslam.team.store import Stream, SubmapStore
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Outgoing


def recompute_centre(log: Recorded) -> dict[Identity, m.Message]:
    """Recompute messages from the inputs of the recorded maps."""
    maps, finals = (log.of(m.FusedMap, each) for each in (ch.FUSED_MAP, ch.FINAL_MAP))
    found: dict[Identity, m.Message] = {}
    for out in _recompute(log, maps, finals):
        found.setdefault(identity(out.key, out.message), out.message)
    return found


_OF_A_PEER = {
    ch.FUSED_MAP.name: ch.TEAM_MAP,
    ch.PRIOR.name: ch.TEAM_PRIOR,
    ch.FINAL_MAP.name: ch.TEAM_FINAL,
    ch.TRAJECTORY.name: ch.TEAM_TRAJECTORY,
}


def recompute_peer(log: Recorded, robot: str) -> dict[Identity, m.Message]:
    """Recompute a peer's own fold by the same rule."""

    def maps_on(channel: ch.Channel) -> list[m.FusedMap]:
        key = channel.key(robot)
        own = (each.message for each in log.outputs_of(channel) if each.sample.key == key)
        return [each for each in own if isinstance(each, m.FusedMap)]

    found: dict[Identity, m.Message] = {}
    for out in _recompute(log, maps_on(ch.TEAM_MAP), maps_on(ch.TEAM_FINAL)):
        if out.channel.name in _OF_A_PEER and out.name in ("", robot):
            key = _OF_A_PEER[out.channel.name].key(robot)
            found.setdefault(identity(key, out.message), out.message)
    return found


def _recompute(
    log: Recorded, maps: Sequence[m.FusedMap], finals: Sequence[m.FusedMap]
) -> Iterator[Outgoing]:
    if not maps and not finals:
        return
    config, digest = log.central_config()
    kind = node_class(config)
    if RULES[config.fusion].consumes == "submap":
        out = _from_submaps(log, kind.fold_class, (*maps, *finals))
    else:
        announced = {n.removeprefix("robot/") for n in log.configured if n.startswith("robot/")}
        centre: Any = kind(config, sorted(announced.union(log.robots)))
        centre.config_digest = digest
        out = centre.recomputed(log, maps, finals)
    lost = finals[-1].lost if finals else ()
    for each in out:
        message = each.message
        if lost and isinstance(message, m.FusedMap) and message.final:  # no input gives it
            message = msgspec.structs.replace(message, provisional=True, lost=lost)
        yield Outgoing(each.channel, each.name, message)


def _from_submaps(
    log: Recorded, kind: type[SubmapFold], maps: Sequence[m.FusedMap]
) -> Iterator[Outgoing]:
    recorded = _RecordedSet(log)
    config, digest = log.central_config()
    fold: SubmapFold | None = None
    for fused in maps:
        chains = recorded.chains(fused)
        if chains is None:
            continue
        if fold is None or not _extends(fold.store, chains, fused):
            fold = kind(config, digest, convicts=False)
        recorded.copy(fold.store, chains, fused)
        tail: Tail = "final" if fused.final else "provisional" if fused.provisional else "closed"
        yield from fold.make_map(tail, recorded=recorded.fields(fused))


def _extends(
    store: SubmapStore, chains: Mapping[Stream, Sequence[m.Submap]], fused: m.FusedMap
) -> bool:
    return (
        store.withdrawals.keys() <= {*fused.withdrawn}
        and store.verdicts <= {*fused.verdicts}
        and all(len(chains.get(s, ())) >= len(chain) for s, chain in store.chains.items())
    )


def recorded_map(log: Recorded, name: str) -> m.SavedMap:
    """Make a saved map of a log's final map. Raises RerunError, NothingToSaveError."""
    found = log.of(m.FusedMap, ch.FINAL_MAP) or log.of(m.FusedMap, ch.TEAM_FINAL)
    finals = [each for each in found if each.rule == "join"]
    if not finals:
        raise RerunError("the log has no final map of the rule join")
    config, digest = log.central_config()
    recorded, fold = _RecordedSet(log), SubmapFold(config, digest, convicts=False)
    chains = recorded.chains(finals[-1])
    if chains is None:
        raise RerunError("the log lacks submaps of its final map")
    recorded.copy(fold.store, chains, finals[-1])
    fold.make_map("final", recorded=recorded.fields(finals[-1]))
    return fold.save_map(name)


class _RecordedSet:
    def __init__(self, log: Recorded) -> None:
        self._store = SubmapStore()
        sightings = log.sightings()
        for stream, submaps in log.submaps().items():
            for sequence in sorted(submaps):
                self._store.add_submap(submaps[sequence])
                for each in sightings.get((*stream, sequence), ()):
                    self._store.add_sighting(each)
        for measurements in log.measurements.values():
            start = measurements.get(0)
            if isinstance(start, m.InitialPose):
                self._store.add_start(start)
        for saved in log.saved_maps.values():
            self._store.add(saved)
        self._maps = log.saved_maps
        self._priors_of: dict[bytes, set[Stream]] = {}
        for prior in log.of(m.Prior, ch.PRIOR, ch.TEAM_PRIOR):
            self._priors_of.setdefault(prior.digest, set()).add((prior.robot, prior.incarnation))

    def chains(self, fused: m.FusedMap) -> Mapping[Stream, Sequence[m.Submap]] | None:
        """Submaps that a map names; None if any is missing."""
        stored = self._store.chains
        named = (*fused.members, *fused.left_out)
        vector = {(x.robot, x.incarnation): x.sequence for x in named}
        if any(len(stored.get(stream, ())) <= last for stream, last in vector.items()):
            return None
        return {stream: stored[stream][: last + 1] for stream, last in vector.items()}

    def copy(
        self, store: SubmapStore, chains: Mapping[Stream, Sequence[m.Submap]], fused: m.FusedMap
    ) -> None:
        for stream, chain in chains.items():
            if (saved := self._maps.get(stream[0])) is not None:
                store.add(saved)
                continue
            store.add_start(self._store.start(stream))
            for submap in chain[len(store.chain(stream)) :]:
                for member in (*self._store.sightings(submap), submap):
                    store.add(member)
        for robot in fused.withdrawn:
            store.add(m.Withdrawal(stamp_ns=fused.stamp_ns, robot=robot, by="log", reason=""))
        for each in fused.verdicts:
            store.add(
                m.Verdict(
                    stamp_ns=fused.stamp_ns, robot=each.first.robot, judgement=each, by="log",
                    reason="",
                )
            )  # fmt: skip

    def fields(self, fused: m.FusedMap) -> RecordedFields:
        """Fields of a map that do not follow from its set."""
        priors_of = self._priors_of.get(fused.digest, set())
        return RecordedFields(fused.missing, fused.heard, priors_of)
