import re
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

from teamslam.team.wire.channels import Channel
from teamslam.team.wire.zenoh.bus import ZenohBus
from tests.system.processes import until


class Observer:
    def __init__(self, endpoint: str, channels: Sequence[Channel], team: str = "short") -> None:
        self._bus = ZenohBus(team, endpoint)
        self._counts: dict[str, int] = {}
        for channel in channels:
            self._bus.subscribe(channel)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._bus.close()

    def count(self, channel: Channel, name: str = "") -> int:
        for sample in self._bus.receive():
            self._counts[sample.key] = self._counts.get(sample.key, 0) + 1
        return self._counts.get(channel.key(name), 0)

    async def sees(self, number: int, channel: Channel, name: str = "") -> None:
        what = f"{number} messages of {channel.key(name)}"
        await until(lambda: self.count(channel, name) >= number, what)


async def endpoint_of(folder: Path, last: str = "world") -> str:
    """Endpoint of the router of the launch in this folder, once all processes are started.

    last: the process that starts last; a live team has no world.
    """
    await until((folder / f"{last}.log").exists, f"the {last} is started")
    said = folder / "router.log"
    spoken = re.compile(r"^listening at (\S+)$", re.MULTILINE)
    await until(lambda: said.exists() and spoken.search(said.read_text()), "the router listens")
    found = spoken.search(said.read_text())
    return found[1]
