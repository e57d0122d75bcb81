from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import msgspec

from teamslam.central.desk.verification.centre import recompute_centre
from teamslam.central.desk.verification.recorded import Recorded, identity
from teamslam.sim.in_memory.team import run_team
from teamslam.sim.scenarios.scenario import Scenario, load, with_options
from teamslam.sim.scenarios.source import streams_of
from teamslam.team.recording.provenance import provenance
from teamslam.team.recording.reader import Log, open_log
from teamslam.team.recording.recorder import Recorder
from teamslam.team.wire import channels as ch, messages as m
from teamslam.team.wire.bus import Sample, opened
from teamslam.team.wire.codec import encoded
from tests.scenarios import with_front_ends, with_world
from tests.teams import Team

Change = Callable[[m.Message], m.Message | None]


def thesis(steps: int, **options: str | int) -> Scenario:
    scenario = with_options(load("thesis"), **options)
    return with_front_ends(with_world(scenario, steps=steps), window_s=10.0)


def team_samples(scenario: Scenario) -> list[Sample]:
    return list(run_team(scenario, streams_of(scenario)))


def written(path: Path, samples: Iterable[Sample], more: Mapping[str, str] | None = None) -> Log:
    """A log of these samples, with this process's provenance and `more`."""
    with Recorder(path, "test", {**provenance(), **(more or {})}) as recorder:
        recorder.write(samples)
    return open_log(path)


def changed(samples: Sequence[Sample], channel: ch.Channel, change: Change) -> list[Sample]:
    out = []
    for sample in samples:
        found, _, message = opened(sample)
        if found != channel:
            out.append(sample)
        elif (other := change(message)) is not None:
            out.append(msgspec.structs.replace(sample, payload=encoded(other)))
    return out


def messages(samples: Iterable[Sample], channel: ch.Channel, name: str = "") -> list[m.Message]:
    return [opened(s)[2] for s in samples if s.key == channel.key(name)]


def said(team: Team) -> list[Sample]:
    return [
        Sample(key, encoded(message), message.stamp_ns, 0, counter)
        for key, sent in team.sent.items()
        for counter, message in enumerate(sent)
    ]


def check_recomputed(samples: Sequence[Sample]) -> None:
    recorded = Recorded()
    recorded.take_all(samples)
    computed = recompute_centre(recorded)
    maps = [*recorded.outputs_of(ch.FUSED_MAP), *recorded.outputs_of(ch.FINAL_MAP)]
    assert maps
    for each in maps:
        assert encoded(computed[identity(each.sample.key, each.message)]) == each.sample.payload
