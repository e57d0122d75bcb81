from pathlib import Path

from teamslam.team.recording.reader import Log, open_log
from teamslam.team.recording.recorder import Recorder
from teamslam.team.wire import channels as c, messages as m
from teamslam.team.wire.bus import Outgoing, Sample
from teamslam.team.wire.codec import encoded
from tests.support import examples, on_its_key


def sampled(channel: c.Channel, name: str, message: m.Message, counter: int = 0) -> Sample:
    key = Outgoing(channel, name, message).key
    return Sample(key, encoded(message), message.stamp_ns, 10**18 + counter, counter)


def recorded(path: Path, samples: list[Sample], **metadata: str) -> Log:
    with Recorder(path, "t", metadata) as recorder:
        recorder.write(samples)
    return open_log(path)


def recorded_examples() -> list[tuple[c.Channel, m.Message, Sample]]:
    of = {kind: channel for channel in c.CHANNELS if channel.recorded for kind in channel.kinds}
    kept = [(of[type(x)], on_its_key(of[type(x)], "alpha", x)) for x in examples() if type(x) in of]
    return [(channel, x, sampled(channel, "alpha", x, i)) for i, (channel, x) in enumerate(kept)]
