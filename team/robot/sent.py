"""Keeps what a robot has sent for fusion, also in an earlier process, for whoever requests it."""

from collections.abc import Iterator
from dataclasses import dataclass, field

from team.wire import messages as m


@dataclass
class Sent:
    """The initial poses, submaps and inter-robot factors that were sent, by incarnation.

    A resumed robot's publisher has only what this process published; this has what it took over,
    too, so that a centre that is started again can be given everything.
    """

    starts: dict[int, m.InitialPose] = field(default_factory=dict)
    submaps: dict[int, dict[int, m.Submap]] = field(default_factory=dict)
    factors: dict[int, dict[tuple[int, int, str], m.SightingFactor]] = field(default_factory=dict)

    def take(self, message: m.Message) -> None:
        """Keep a message for fusion."""
        match message:
            case m.InitialPose():
                self.starts[message.incarnation] = message
            case m.Submap():
                self.submaps.setdefault(message.incarnation, {})[message.sequence] = message
            case m.SightingFactor():
                name = (message.sequence, message.stamp_ns, message.teammate)
                self.factors.setdefault(message.incarnation, {})[name] = message
            case _:
                pass

    def answer(self, request: m.SubmapsRequest) -> Iterator[m.Message]:
        """Answer a request: of each incarnation its initial pose, then factors and submaps by
        sequence.
        """
        for incarnation in (
            sorted(self.starts) if request.incarnation == 0 else [request.incarnation]
        ):
            first = request.first if request.incarnation else 0
            if incarnation in self.starts:
                yield self.starts[incarnation]
            factors = self.factors.get(incarnation, {})
            yield from (factors[name] for name in sorted(factors) if name[0] >= first)
            submaps = self.submaps.get(incarnation, {})
            yield from (submaps[k] for k in sorted(submaps) if k >= first)
