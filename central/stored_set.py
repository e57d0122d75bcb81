"""A centre's set on disk: the messages of robots and operators, as they were sent.

The file format is a peer's (`teamslam.team.peers.set_file`). A restarted centre continues from it:
no member is sent again, and the same set gives the same map.
"""

import time
from collections.abc import Iterable
from pathlib import Path

from teamslam.team.peers.members import CHANNELS, member_of
from teamslam.team.peers.set_file import Keeper
from teamslam.team.wire import channels as ch
from teamslam.team.wire.bus import Sample
from teamslam.team.wire.codec import WireError

_STORED = tuple(each for each in CHANNELS if each not in (ch.CONCLUDED, ch.CERTIFICATE))


class StoredSet:
    """Stores each member once. Raises SetFileError if the file is unusable."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._keeper = Keeper(path)
        self._found = self._keeper.members
        self._known = {member.hash for member in self._found}

    @property
    def warnings(self) -> tuple[str, ...]:
        """The members missing in the file, for the centre's status."""
        return self._keeper.warnings

    def samples(self) -> list[Sample]:
        """Return the members in the file as samples that arrive now."""
        now_ns, found = time.time_ns(), self._found
        self._found = []
        return [member.as_sample(now_ns) for member in found]

    def note(self, samples: Iterable[Sample]) -> None:
        """Store the valid and new members among these samples."""
        news = []
        for sample in samples:
            found = ch.channel_of(sample.key)
            if found is None or found[0] not in _STORED:
                continue
            try:
                member = member_of(sample.key, sample.payload)
            except (WireError, ValueError):
                continue  # the door counts and names it
            if member.hash not in self._known:
                self._known.add(member.hash)
                news.append(member)
        self._keeper.append(news)

    def close(self) -> None:
        """Close the file."""
        self._keeper.close()
