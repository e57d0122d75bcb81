"""A centre's set on disk: the messages of robots and operators for it, as they were sent.

The file is a peer's (`team.peers.store`). A centre that was killed reads it and continues: nothing
of it has to be sent again, and the same set gives the same map.
"""

import logging
import time
from collections.abc import Iterable
from pathlib import Path

from team.peers.members import CHANNELS, Member, member_of
from team.peers.store import Store, StoreError
from team.wire import channels as ch
from team.wire.bus import NO_COUNTER, Sample
from team.wire.codec import WireError

_KEPT = tuple(each for each in CHANNELS if each not in (ch.CONCLUDED, ch.CERTIFICATE))
_LOG = logging.getLogger("teamslam")


class KeptSet:
    """Keeps each member once. Raises StoreError where the file can not be used."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._store: Store | None = Store(path)
        self._found = self._store.kept
        self._known = {member.hash for member in self._found}

    def samples(self) -> list[Sample]:
        """The members in the file, as samples that arrive now."""
        now_ns, found = time.time_ns(), self._found
        self._found = []
        return [_as_heard(member, now_ns) for member in found]

    def note(self, samples: Iterable[Sample]) -> None:
        """Keep the valid and new members among these samples."""
        if self._store is None:
            return
        news = []
        for sample in samples:
            found = ch.channel_of(sample.key)
            if found is None or found[0] not in _KEPT:
                continue
            try:
                member = member_of(sample.key, sample.payload)
            except (WireError, ValueError):
                continue  # the door counts and names it
            if member.hash not in self._known:
                self._known.add(member.hash)
                news.append(member)
        try:
            self._store.append(news)
        except StoreError as error:
            _LOG.error("the set is not kept any more: %s", error)
            self.close()

    def close(self) -> None:
        """Close the file."""
        if self._store is not None:
            self._store.close()
            self._store = None


def _as_heard(member: Member, now_ns: int) -> Sample:
    return Sample(member.key, member.payload, member.message.stamp_ns, now_ns, NO_COUNTER)
