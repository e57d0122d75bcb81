import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Self, TypeVar

import msgspec
import numpy as np

from teamslam.team.config import UNNAMED
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import from_floats, from_ids, from_stamps
from teamslam.team.wire.bus import Bus, Sample
from teamslam.team.wire.channels import Channel
from tests import build

ROOT = Path(__file__).parents[1]


def wait_until(condition: Callable[[], bool], timeout_s: float = 60.0, what: str = "") -> None:
    wake = threading.Event()
    end = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end, f"not within {timeout_s} s: {what or condition}"
        wake.wait(0.002)


def received(bus: Bus, count: int, timeout_s: float = 60.0) -> list[Sample]:
    samples: list[Sample] = []

    def enough() -> bool:
        samples.extend(bus.receive(0.05))
        return len(samples) >= count

    wait_until(enough, timeout_s, f"{count} samples")
    return samples


@contextlib.contextmanager
def nobody_listens() -> Iterator[str]:
    """An endpoint that refuses all connections and that no other process can take."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        yield f"tcp/127.0.0.1:{taken.getsockname()[1]}"


class Link:
    """TCP link to `endpoint` that a test can cut, stall and mend.

    A stalled link accepts connections and forwards nothing, like a stopped process.
    """

    def __init__(self, endpoint: str) -> None:
        protocol, _, at = endpoint.partition("/")
        host, port = at.rsplit(":", 1)
        self._to = (host, int(port))
        self._open: list[socket.socket] = []
        self._whole = True
        self._flows = threading.Event()
        self._flows.set()
        self._turn = threading.Lock()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"{protocol}/127.0.0.1:{self._listener.getsockname()[1]}"
        threading.Thread(target=self._accept, daemon=True).start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.cut()
        self._flows.set()
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()

    def cut(self) -> None:
        with self._turn:
            self._whole = False
            for connection in self._open:
                with contextlib.suppress(OSError):
                    connection.shutdown(socket.SHUT_RDWR)
                connection.close()
            self._open.clear()

    def stall(self) -> None:
        self._flows.clear()

    def mend(self) -> None:
        self._whole = True
        self._flows.set()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                near, _ = self._listener.accept()
                with self._turn:
                    self._join(near)

    def _join(self, near: socket.socket) -> None:
        try:
            if not self._whole:
                raise ConnectionError
            far = socket.create_connection(self._to)
        except OSError:  # cut or refused; the next one may pass
            near.close()
            return
        self._open += [near, far]
        for pair in ((near, far), (far, near)):
            threading.Thread(target=_pump, args=(*pair, self._flows), daemon=True).start()


def _pump(source: socket.socket, sink: socket.socket, flows: threading.Event) -> None:
    with contextlib.suppress(OSError):
        while data := source.recv(65_536):
            flows.wait()
            sink.sendall(data)
        sink.shutdown(socket.SHUT_RDWR)


def spd(n: int) -> np.ndarray:
    return 2.0 * np.eye(n) + 0.5 ** (1 + np.abs(np.subtract.outer(np.arange(n), np.arange(n))))


def packed(matrix: np.ndarray) -> bytes:
    return from_floats(matrix[np.triu_indices(len(matrix))])


def odometry(i: int, robot: str = "alpha") -> m.Odometry:
    return build.odometry(
        stamp_ns=i * 1_000_000,
        robot=robot,
        incarnation=0,
        number=i,
        duration_ns=1_000_000,
        forward=0.5,
    )


def submap(i: int, robot: str = "alpha", landmarks: int = 2) -> m.Submap:
    n = 3 + 2 * landmarks
    return build.submap(
        stamp_ns=(i + 1) * 1_000_000,
        robot=robot,
        incarnation=0,
        sequence=i,
        first_measurement=10 * i,
        last_measurement=10 * i + 9,
        start_ns=i * 1_000_000,
        config=b"configur",
        ids=range(landmarks),
        mean=np.arange(n) / 8.0,
        covariance=packed(spd(n)),
    )


def on_its_key(channel: Channel, name: str, message: m.Message) -> m.Message:
    publisher = channel.publisher(name)
    says = m.Configuration | m.Progress | m.Status | m.Liveliness | m.Fault | m.SetSummary
    return (
        msgspec.structs.replace(message, node=publisher) if isinstance(message, says) else message
    )


def peers_examples(digest: bytes) -> Iterator[m.Message]:
    holding = build.holding(robot="alpha", sequences=(0, 4, 6, 6), digest=digest, newest_ns=9)
    statements = m.Statements(robot="alpha", count=2, digest=digest)
    yield build.set_summary(
        stamp_ns=9,
        node="robot/bravo",
        serial=3,
        digest=digest,
        holdings=(holding,),
        statements=(statements,),
    )
    wanted = build.requested(robot="alpha", start=False, first=5, last=5)
    yield build.members_request(
        stamp_ns=9, node="robot/bravo", requested=(wanted,), statements=("alpha",)
    )
    yield build.members(
        stamp_ns=9,
        node="robot/alpha",
        keys=("robot/alpha/submap",),
        payloads=(b"bytes",),
        signatures=(b"",),
    )
    yield m.Certificate(stamp_ns=0, robot="alpha", certificate=b"DER")
    yield m.Signature(stamp_ns=9, robot="alpha", member=4 * digest, signature=b"ECDSA")
    yield m.RadioPlan(stamp_ns=0, robots=("alpha", "bravo"), ends_ns=(9, 8), pairs=b"\x80\x00")
    yield build.concluded(
        stamp_ns=9, robot="alpha", serial=1, digest=digest, sha256=4 * digest, submaps=7
    )


def examples() -> Iterator[m.Message]:
    two, three = from_ids([4, 7]), from_floats([1.0, -0.5, 0.25])
    means, blocks = from_floats([1.0, 2.0, 3.0, 4.0]), from_floats([2.0, 0.5, 1.0] * 2)
    digest = b"\x00\x01\x02\x03\xfc\xfd\xfe\xff"
    member = m.VersionEntry(robot="alpha", incarnation=1, sequence=5)
    yield build.initial_pose(robot="alpha", pose=three, covariance=spd(3))
    yield build.odometry(
        stamp_ns=1_000,
        robot="alpha",
        number=2,
        duration_ns=100_000_000,
        forward=0.25,
        yaw_rate=-0.125,
    )
    yield build.increment(
        stamp_ns=1_000,
        robot="alpha",
        number=2,
        duration_ns=100_000_000,
        increment=three,
        covariance=spd(3),
    )
    yield m.Steering(
        stamp_ns=1_000,
        robot="alpha",
        incarnation=1,
        number=2,
        duration_ns=100_000_000,
        wheel_speed=2.5,
        steering=-0.125,
    )
    yield build.observations(
        stamp_ns=2_000,
        robot="alpha",
        number=3,
        ids=two,
        ranges=[2.0, 3.5],
        bearings=[0.5, -1],
        covariances=blocks,
    )
    yield build.points(
        stamp_ns=2_000, robot="alpha", number=3, ids=two, positions=means, covariances=blocks
    )
    yield build.detections(
        stamp_ns=2_500,
        robot="alpha",
        number=3,
        ranges=[2.0, 3.5],
        bearings=[0.5, -1],
        covariances=blocks,
        signatures=[0.25, 0.5],
        classes=[-0.25, -1.5, -2.0, -0.125],
    )
    yield build.sightings(
        stamp_ns=3_000, robot="alpha", number=4, teammates=("bravo",), ranges=[6.0], bearings=[-3.0]
    )
    yield build.truth(stamp_ns=4_000, robot="alpha", stamps=[0, 4_000], poses=range(6))
    yield m.TruthLandmarks(stamp_ns=-5, ids=two, positions=means)
    yield m.TruthLabels(
        stamp_ns=-5,
        robot="alpha",
        stamps=from_stamps([2_500]),
        counts=from_ids([2]),
        labels=from_ids([7, m.NO_LABEL]),
    )
    yield m.TruthPositions(
        stamp_ns=-5,
        robot="alpha",
        stamps=from_stamps([0, 4_000]),
        positions=from_floats([0.0, 0.5, 1.0, 1.5]),
    )
    yield m.KnownMap(stamp_ns=-5, ids=two, positions=means)
    yield build.configuration(node="robot/alpha", digest=digest, configuration='{"seed": 7}')
    yield build.submap(
        stamp_ns=9_000,
        robot="alpha",
        sequence=5,
        first_measurement=10,
        last_measurement=19,
        start_ns=8_000,
        config=digest,
        ids=[4, UNNAMED + 1],
        mean=range(10),
        covariance=packed(spd(10)),
        nodes=[8_500],
        sightings=1,
        biases=("bearing", "range_scale"),
        sensitivity=np.arange(20) / 16.0,
        gated=3,
        counts=[6],
        seen=b"\x05\x01",
        keyframes=9,
        classes=[-0.25, -1.5, -2.0, -0.125],
    )
    yield m.Association(
        stamp_ns=9_000,
        robot="alpha",
        incarnation=1,
        sequence=5,
        stamps=from_stamps([8_200, 8_400]),
        counts=from_ids([1, 2]),
        rows=from_ids([0, 0, 2]),
        landmarks=from_ids([UNNAMED + 1, m.CLUTTER, m.UNCONFIRMED]),
    )
    yield build.sighting_factor(
        stamp_ns=8_500,
        robot="alpha",
        sequence=5,
        config=digest,
        teammate="bravo",
        range=6.0,
        bearing=-3.0,
        covariance=packed(spd(2)),
        measurements=(12, 14),
    )
    yield build.withdrawal(stamp_ns=9_000, robot="alpha", reason="its wheel is flat")
    yield m.Verdict(
        stamp_ns=0,
        robot="alpha",
        judgement=m.Judgement(
            first=m.LocalLandmark(robot="alpha", incarnation=1, sequence=3, local=5),
            second=m.LocalLandmark(robot="beta", incarnation=1, sequence=8, local=0),
            same=True,
        ),
        by="operator",
        reason="the same tree",
    )
    yield build.withdrawal_heard(
        stamp_ns=9_000, robot="alpha", withdrawn="bravo", reason="its wheel is flat"
    )
    yield build.map_estimate(
        stamp_ns=9_000,
        robot="alpha",
        sequence=5,
        joint=False,
        ids=two,
        means=means,
        covariance=blocks,
    )
    yield build.pose_estimate(
        stamp_ns=9_000,
        robot="alpha",
        sequence=5,
        map_digest=digest,
        pose=three,
        covariance=spd(3),
        frame="bravo/1",
        in_team_frame=False,
    )
    yield m.ParticleCloud(
        stamp_ns=9_000,
        robot="alpha",
        poses=from_floats(range(6)),
        weights=from_floats([0.25, 0.75]),
    )
    yield m.Innovation(
        stamp_ns=9_000, robot="alpha", incarnation=1, sequence=5, squared=20.5, dof=22
    )
    yield build.fused_map(
        stamp_ns=9_000,
        digest=digest,
        frame="alpha/1",
        final=True,
        members=(member,),
        missing=(m.VersionEntry(robot="bravo", incarnation=0, sequence=2),),
        ids=two,
        means=means,
        covariance=packed(spd(4)),
        chi2=12.5,
        dof=14,
        reasons=("bravo: 1 shared landmark, 2 needed",),
        biases=(
            m.BiasEstimate(robot="alpha", incarnation=1, bias="bearing", value=0.25, sigma=0.125),
        ),
        joined=("charlie joined: 5 landmarks",),
        withdrawn=("charlie",),
        covariance_scale=1.25,
        lost=(),
        heard=9,
        memberships=(
            m.Membership(
                robot="alpha",
                incarnation=1,
                sequences=from_ids(np.array([0, 1], np.uint32)),
                locals=from_ids(np.array([4, 2], np.uint32)),
                identities=from_ids(np.array([2**31 + 7, 2**31 + 7], np.uint32)),
                steps=bytes([0, 1]),
                figures=from_floats(np.array([0.0, 0.0, 0.0, 5.5, -2.0, 0.25])),
            ),
        ),
        decisions=(
            m.AssociationDecision(
                stamp_ns=8_000,
                kind="merge",
                about="alpha (incarnation 1) and bravo (incarnation 0)",
                pairs=12,
                llr=40.5,
                rival_pairs=5,
                rival_llr=6.0,
                share=0.75,
                sd=20.0,
                why="",
            ),
        ),
        diagnosis=(
            m.Diagnosis(
                cause="landmark_moved",
                landmark=7,
                value=(2.0, 0.125),
                sigma=(0.25, 0.25),
                evidence=331.5,
                remedy="remove the landmark",
                at_ns=150 * 10**9,
            ),
        ),
        verdicts=(
            m.Judgement(
                first=m.LocalLandmark(robot="alpha", incarnation=1, sequence=0, local=4),
                second=m.LocalLandmark(robot="alpha", incarnation=1, sequence=1, local=2),
                same=True,
            ),
        ),
        changes=(
            m.LandmarkChange(landmark=4, state="moved", dx=0.5, dy=-0.25, sigma=0.125, chi2=17.0),
            m.LandmarkChange(landmark=7, state="gone", expected=9.5),
        ),
    )
    yield m.SavedMap(
        stamp_ns=9_000,
        name="site",
        ids=from_ids([4, UNNAMED]),
        means=means,
        covariance=packed(spd(4)),
        biases=("range_scale",),
        sensitivity=means,
        counts=from_ids([3, 1]),
        frame="alpha/1",
        sets=(digest,),
        software="1.2.3",
        core="0123456789abcdef",
        datum=from_floats([48.5, 9.25, 512.0]),
        own=(
            m.RobotBias(robot="alpha", bias="range_offset"),
            m.RobotBias(robot="beta", bias="forward_scale"),
        ),
        own_means=from_floats([0.5, -0.25]),
        own_covariance=from_floats([2.0, 0.5, 1.0]),
        own_cross=from_floats([0.125, 0.0, -0.125, 0.25, 0.0, 0.125, 0.0, -0.25]),
        own_sensitivity=from_floats([1.0, -2.0]),
        likeliest=from_floats([0.25, 0.5, -0.25]),
        evidence=packed(spd(3)),
        classes=from_floats([-0.25, -1.5]),
    )
    yield build.prior(
        stamp_ns=9_000,
        robot="alpha",
        sequence=5,
        digest=digest,
        ids=two,
        mean=range(7),
        covariance=packed(spd(7)),
        covariance_factor=2.5,
        biases=(
            m.BiasEstimate(
                robot="alpha", incarnation=1, bias="range_scale", value=0.25, sigma=0.125
            ),
        ),
        members=(member,),
        heard=9,
        withdrawn=1,
        frame="bravo/1",
        in_team_frame=True,
    )
    yield build.trajectory(
        stamp_ns=9_000,
        robot="alpha",
        digest=digest,
        stamps=[9_000],
        poses=three,
        covariances=spd(3),
        start=[0.5, 0.25, 0.125],
        start_covariance=spd(3),
        crosses=range(9),
    )
    yield build.progress(stamp_ns=9_000, node="central", robot="alpha", measurements=128, submaps=6)
    yield m.Rendezvous(
        stamp_ns=9_000, robot="alpha", incarnation=1, teammates=("bravo",), submaps=3, waited_s=12.5
    )
    yield build.done(
        stamp_ns=9_000,
        robot="alpha",
        measurements=200,
        steps=99,
        submaps=20,
        ledger=(m.Disposition(disposition="in a submap", measurements=200),),
        last_map=7,
    )
    yield m.End(
        stamp_ns=9_000,
        streams=(m.StreamEnd(robot="alpha", incarnation=1, measurements=200),),
        notes=("gap of 3 s",),
    )
    yield m.StreamHead(stamp_ns=9_000, robot="alpha", incarnation=1, measurements=200, state="open")
    yield m.Fix(
        stamp_ns=9_000,
        robot="alpha",
        incarnation=1,
        number=7,
        position=from_floats([3.0, 4.0]),
        covariance=from_floats([4.0, 0.0, 4.0]),
    )
    yield build.team_end(reason="the batteries are empty")
    yield build.status(
        stamp_ns=9_000,
        node="recorder",
        state="recording",
        figures={"messages": 12.0},
        warnings=("slow disk",),
        run="0123456789abcdef",
    )
    yield build.given_up(stamp_ns=9_000, node="robot/alpha", reason="it fell into the water")
    yield build.kept_request(channels=("final_map",), node="robot/alpha", run_ns=5_000_000_000)
    yield build.kept(stamp_ns=9_000, key="central/final", payload=b"\x91\xc0", wall_ns=10**18)
    yield m.FoldRequest(stamp_ns=0)
    yield from peers_examples(digest)
    yield build.fault(
        stamp_ns=9_000,
        node="central",
        origin="robot/alpha/submap",
        count=7,
        message="submap/1",
        error="ValueError",
        text="no frame",
        place="central.node:CentralNode.handle:58",
        digest=b"\x01\x02\x03\x04\x05\x06\x07\x08",
    )
    yield build.liveliness(node="robot/alpha")
    yield build.tally(
        stamp_ns=9_000,
        node="robot/alpha",
        since_ns=10**18,
        keys=("robot/alpha/submap",),
        counts=(6,),
    )
    yield build.measurements_request(robot="alpha", first=5)
    yield build.submaps_request(robot="alpha")


K = TypeVar("K", bound=m.Message)


def example(kind: type[K], **fields: object) -> K:
    found = next(each for each in examples() if isinstance(each, kind))
    return msgspec.structs.replace(found, **fields)


fused_map = partial(build.fused_map, joint=False, ids=b"", means=b"", covariance=b"")
"""A map of the rule `join` in r1's frame, empty unless these fields are given."""
