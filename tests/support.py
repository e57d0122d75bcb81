"""What several tests need: waiting for a condition, a link that can be cut, sample messages."""

import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Self

import msgspec
import numpy as np

from team.wire import messages as m
from team.wire.arrays import from_floats, from_ids, from_stamps
from team.wire.bus import Bus, Sample
from team.wire.channels import Channel

ROOT = Path(__file__).parents[1]


def wait_until(condition: Callable[[], bool], timeout_s: float = 20.0, what: str = "") -> None:
    """Return as soon as the condition holds; fail when it does not within the time."""
    wake = threading.Event()
    end = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end, f"not within {timeout_s} s: {what or condition}"
        wake.wait(0.002)


def received(bus: Bus, count: int, timeout_s: float = 20.0) -> list[Sample]:
    """The first `count` samples or more; fails when fewer arrive within the time."""
    samples: list[Sample] = []

    def enough() -> bool:
        samples.extend(bus.receive(0.05))
        return len(samples) >= count

    wait_until(enough, timeout_s, f"{count} samples")
    return samples


class Link:
    """A TCP link to `endpoint` that a test can cut and mend."""

    def __init__(self, endpoint: str) -> None:
        host, port = endpoint.removeprefix("tcp/").rsplit(":", 1)
        self._to = (host, int(port))
        self._open: list[socket.socket] = []
        self._whole = True
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"tcp/127.0.0.1:{self._listener.getsockname()[1]}"
        threading.Thread(target=self._accept, daemon=True).start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.cut()
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()

    def cut(self) -> None:
        self._whole = False
        for connection in self._open:
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
            connection.close()
        self._open.clear()

    def mend(self) -> None:
        self._whole = True

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                near, _ = self._listener.accept()
                if not self._whole:
                    near.close()
                    continue
                far = socket.create_connection(self._to)
                self._open += [near, far]
                for pair in ((near, far), (far, near)):
                    threading.Thread(target=_pump, args=pair, daemon=True).start()


def _pump(source: socket.socket, sink: socket.socket) -> None:
    with contextlib.suppress(OSError):
        while data := source.recv(65_536):
            sink.sendall(data)
        sink.shutdown(socket.SHUT_RDWR)


def spd(n: int) -> np.ndarray:
    """A symmetric positive definite n × n matrix."""
    return 2.0 * np.eye(n) + 0.5 ** (1 + np.abs(np.subtract.outer(np.arange(n), np.arange(n))))


def packed(matrix: np.ndarray) -> bytes:
    """The upper triangle, row by row."""
    return from_floats(matrix[np.triu_indices(len(matrix))])


def odometry(i: int, robot: str = "alpha") -> m.Odometry:
    return m.Odometry(i * 1_000_000, robot, 0, i, 1_000_000, 0.5, 0.1)


def submap(i: int, robot: str = "alpha", landmarks: int = 2) -> m.Submap:
    n = 3 + 2 * landmarks
    return m.Submap(
        (i + 1) * 1_000_000,
        robot,
        0,
        i,
        10 * i,
        10 * i + 9,
        i * 1_000_000,
        b"configur",
        from_ids(range(landmarks)),
        from_floats(np.arange(n) / 8.0),
        packed(spd(n)),
    )


def on_its_key(channel: Channel, name: str, message: m.Message) -> m.Message:
    """The message as the node says it that publishes on the channel's key for this name."""
    speaker = channel.speaker(name)
    says = m.Configuration | m.Progress | m.Status | m.Liveliness | m.Fault
    return msgspec.structs.replace(message, node=speaker) if isinstance(message, says) else message


def examples() -> Iterator[m.Message]:
    """One message of every class, with every array filled."""
    two, three = from_ids([4, 7]), from_floats([1.0, -0.5, 0.25])
    means, blocks = from_floats([1.0, 2.0, 3.0, 4.0]), from_floats([2.0, 0.5, 1.0] * 2)
    digest = b"\x00\x01\x02\x03\xfc\xfd\xfe\xff"
    member = m.VersionEntry("alpha", 1, 5)
    yield m.InitialPose(0, "alpha", 1, 0, three, from_floats(spd(3)))
    yield m.Odometry(1_000, "alpha", 1, 2, 100_000_000, 0.25, -0.125)
    yield m.Observations(2_000, "alpha", 1, 3, two, from_floats([2.0, 3.5]), from_floats([0.5, -1]))
    yield m.Sightings(3_000, "alpha", 1, 4, ("bravo",), from_floats([6.0]), from_floats([-3.0]))
    yield m.Truth(4_000, "alpha", from_stamps([0, 4_000]), from_floats(range(6)))
    yield m.TruthLandmarks(-5, two, means)
    yield m.KnownMap(-5, two, means)
    yield m.Configuration(0, "robot/alpha", 1, digest, '{"seed": 7}')
    yield m.Submap(
        9_000, "alpha", 1, 5, 10, 19, 8_000, digest, two, from_floats(range(10)), packed(spd(10)),
        from_stamps([8_500]), 1, ("bearing", "range_scale"), from_floats(np.arange(20) / 16.0),
        3,
    )  # fmt: skip
    yield m.SightingFactor(
        8_500, "alpha", 1, 5, digest, "bravo", 6.0, -3.0, packed(spd(2)), (12, 14)
    )
    yield m.Withdrawal(9_000, "alpha", "operator", "its wheel is flat")
    yield m.WithdrawalHeard(9_000, "alpha", "bravo", "operator", "its wheel is flat")
    yield m.MapEstimate(9_000, "alpha", 1, 5, 0, False, two, means, blocks)
    yield m.PoseEstimate(9_000, "alpha", 1, 5, digest, three, from_floats(spd(3)))
    yield m.ParticleCloud(9_000, "alpha", from_floats(range(6)), from_floats([0.25, 0.75]))
    yield m.Innovation(9_000, "alpha", 1, 5, 20.5, 22)
    yield m.FusedMap(
        9_000, "join", digest, "alpha/1", True, False, 0,
        (member,), (m.VersionEntry("bravo", 0, 2),),
        True, two, means, packed(spd(4)), 12.5, 14, ("bravo: 1 shared landmark, 2 needed",),
        (m.BiasEstimate("alpha", 1, "bearing", 0.25, 0.125),), ("charlie joined: 5 landmarks",),
        ("charlie",), 1.25, (), 9,
    )  # fmt: skip
    yield m.Prior(
        9_000, "alpha", 1, 5, digest, two, from_floats(range(7)), packed(spd(7)),
        2.5, (m.BiasEstimate("alpha", 1, "range_scale", 0.25, 0.125),), (member,), 9,
    )  # fmt: skip
    yield m.Trajectory(9_000, "alpha", 1, digest, from_stamps([9_000]), three, from_floats(spd(3)))
    yield m.Progress(9_000, "central", "alpha", 1, 128, 6)
    yield m.Rendezvous(9_000, "alpha", 1, ("bravo",), 3, 12.5)
    yield m.Done(9_000, "alpha", 1, 200, 99, 20, (m.Disposition("in a submap", 200),), 7)
    yield m.End(9_000, (m.StreamEnd("alpha", 1, 200),), ("gap of 3 s",))
    yield m.Status(9_000, "recorder", "recording", {"messages": 12.0}, ("slow disk",))
    yield m.GivenUp(9_000, "robot/alpha", "operator", "it fell into the water")
    yield m.FinalMapRequest(0, "robot/alpha")
    yield m.FinalMapReply(0, 5_000_000_000, b"\x91\xc0", True)
    yield m.OrdersRequest(0)
    yield m.Fault(
        9_000, "central", "robot/alpha/submap", 7, "submap/1", "ValueError", "no frame",
        "central.node:CentralNode.handle:58", b"\x01\x02\x03\x04\x05\x06\x07\x08",
    )  # fmt: skip
    yield m.Liveliness(0, "robot/alpha", True)
    yield m.Tally(9_000, "robot/alpha", 10**18, ("robot/alpha/submap",), (6,))
    yield m.MeasurementsRequest(0, "alpha", 1, 5, -1)
    yield m.SubmapsRequest(0, "alpha")
