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
from teamslam.team.core import wrapped
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import from_floats
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


def state_error(estimate: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Error of a state (x, y, theta, …), theta's in (−π, π]."""
    error = estimate - truth
    error[2] = wrapped(error[2])
    return error


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


DIGEST = b"\x00\x01\x02\x03\xfc\xfd\xfe\xff"
ALPHA = build.ORDINARY | {
    "stamp_ns": 9_000, "robot": "alpha", "sequence": 5, "number": 3, "duration_ns": 100_000_000,
    "digest": DIGEST, "config": DIGEST, "map_digest": DIGEST, "sha256": 4 * DIGEST,
    "ids": [4, 7], "means": [1.0, 2.0, 3.0, 4.0], "positions": [1.0, 2.0, 3.0, 4.0],
    "ranges": [2.0, 3.5], "bearings": [0.5, -1.0], "covariances": [2.0, 0.5, 1.0] * 2,
    "pose": [1.0, -0.5, 0.25], "increment": [1.0, -0.5, 0.25], "covariance": spd(3),
    "measurements": 200, "reason": "its wheel is flat", "state": "open",
    "value": 0.25, "sigma": 0.125, "same": True,
}  # fmt: skip
alpha = partial(build.built, ordinary=ALPHA)
CLASSES = [-0.25, -1.5, -2.0, -0.125]


def place(sequence: int, local: int, robot: str = "alpha") -> m.LocalLandmark:
    return alpha(m.LocalLandmark, robot=robot, sequence=sequence, local=local)


def measured_examples() -> Iterator[m.Message]:
    yield alpha(m.InitialPose, stamp_ns=0, number=0)
    yield alpha(m.Odometry, stamp_ns=1_000, number=2, forward=0.25, yaw_rate=-0.125)
    yield alpha(m.Increment, stamp_ns=1_000, number=2, covariance=spd(3))
    yield alpha(m.Steering, stamp_ns=1_000, number=2, wheel_speed=2.5, steering=-0.125)
    yield alpha(m.Observations, stamp_ns=2_000, covariances=ALPHA["covariances"])
    yield alpha(m.Points, stamp_ns=2_000, covariances=ALPHA["covariances"])
    yield alpha(
        m.Detections,
        stamp_ns=2_500,
        covariances=ALPHA["covariances"],
        signatures=[0.25, 0.5],
        classes=CLASSES,
    )
    yield alpha(
        m.Sightings, stamp_ns=3_000, number=4, teammates=("bravo",), ranges=[6.0], bearings=[-3.0]
    )
    yield alpha(m.Truth, stamp_ns=4_000, stamps=[0, 4_000], poses=range(6))
    yield alpha(m.TruthLandmarks, stamp_ns=-5)
    yield alpha(m.TruthLabels, stamp_ns=-5, stamps=[2_500], counts=[2], labels=[7, m.NO_LABEL])
    yield alpha(m.TruthPositions, stamp_ns=-5, stamps=[0, 4_000], positions=[0.0, 0.5, 1.0, 1.5])
    yield alpha(m.KnownMap, stamp_ns=-5)
    yield alpha(m.Fix, number=7, position=[3.0, 4.0], covariance=[4.0, 0.0, 4.0])


def peers_examples() -> Iterator[m.Message]:
    holding = alpha(m.Holding, sequences=(0, 4, 6, 6), newest_ns=9)
    statements = alpha(m.Statements, count=2)
    bravo = {"stamp_ns": 9, "node": "robot/bravo"}
    yield alpha(m.SetSummary, **bravo, serial=3, holdings=(holding,), statements=(statements,))
    wanted = alpha(m.Requested, start=False, first=5, last=5)
    yield alpha(m.MembersRequest, **bravo, requested=(wanted,), statements=("alpha",))
    keys = ("robot/alpha/submap",)
    yield alpha(m.Members, stamp_ns=9, keys=keys, payloads=(b"bytes",), signatures=(b"",))
    yield alpha(m.Certificate, stamp_ns=0, certificate=b"DER")
    yield alpha(m.Signature, stamp_ns=9, member=4 * DIGEST, signature=b"ECDSA")
    yield m.RadioPlan(stamp_ns=0, robots=("alpha", "bravo"), ends_ns=(9, 8), pairs=b"\x80\x00")
    yield alpha(m.Concluded, stamp_ns=9, serial=1, submaps=7)


def map_examples() -> Iterator[m.Message]:
    member = alpha(m.VersionEntry)
    yield alpha(
        m.FusedMap,
        frame="alpha/1",
        final=True,
        members=(member,),
        missing=(alpha(m.VersionEntry, robot="bravo", incarnation=0, sequence=2),),
        covariance=packed(spd(4)),
        chi2=12.5,
        dof=14,
        reasons=("bravo: 1 shared landmark, 2 needed",),
        biases=(alpha(m.BiasEstimate, bias="bearing"),),
        joined=("charlie joined: 5 landmarks",),
        withdrawn=("charlie",),
        covariance_scale=1.25,
        lost=(),
        heard=9,
        memberships=(
            alpha(
                m.Membership,
                sequences=[0, 1],
                locals=[4, 2],
                identities=[2**31 + 7, 2**31 + 7],
                steps=bytes([0, 1]),
                figures=[0.0, 0.0, 0.0, 5.5, -2.0, 0.25],
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
                place=(4.0, -1.5),
                map_has="second",
            ),
        ),
        verdicts=(m.Judgement(first=place(0, 4), second=place(1, 2), same=True),),
        changes=(
            m.LandmarkChange(landmark=4, state="moved", dx=0.5, dy=-0.25, sigma=0.125, chi2=17.0),
            m.LandmarkChange(landmark=7, state="gone", expected=9.5),
        ),
    )
    own = {"alpha": "range_offset", "beta": "forward_scale"}
    yield alpha(
        m.SavedMap,
        name="site",
        ids=[4, UNNAMED],
        covariance=packed(spd(4)),
        biases=("range_scale",),
        sensitivity=ALPHA["means"],
        counts=[3, 1],
        frame="alpha/1",
        sets=(DIGEST,),
        software="1.2.3",
        core="0123456789abcdef",
        datum=[48.5, 9.25, 512.0],
        own=tuple(m.RobotBias(robot=robot, bias=bias) for robot, bias in own.items()),
        own_means=[0.5, -0.25],
        own_covariance=[2.0, 0.5, 1.0],
        own_cross=[0.125, 0.0, -0.125, 0.25, 0.0, 0.125, 0.0, -0.25],
        own_sensitivity=[1.0, -2.0],
        likeliest=[0.25, 0.5, -0.25],
        evidence=packed(spd(3)),
        classes=CLASSES[:2],
    )
    yield alpha(
        m.Prior,
        mean=range(7),
        covariance=packed(spd(7)),
        covariance_factor=2.5,
        biases=(alpha(m.BiasEstimate, bias="range_scale"),),
        members=(member,),
        heard=9,
        withdrawn=1,
        frame="bravo/1",
        in_team_frame=True,
    )


def robot_examples() -> Iterator[m.Message]:
    yield alpha(
        m.Submap,
        first_measurement=10,
        last_measurement=19,
        start_ns=8_000,
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
        classes=CLASSES,
    )
    yield alpha(
        m.Association,
        stamps=[8_200, 8_400],
        counts=[1, 2],
        rows=[0, 0, 2],
        landmarks=[UNNAMED + 1, m.CLUTTER, m.UNCONFIRMED],
    )
    yield alpha(
        m.SightingFactor,
        stamp_ns=8_500,
        teammate="bravo",
        range=6.0,
        bearing=-3.0,
        covariance=packed(spd(2)),
        measurements=(12, 14),
    )
    yield alpha(m.MapEstimate, joint=False, covariance=ALPHA["covariances"])
    yield alpha(m.PoseEstimate, frame="bravo/1", in_team_frame=False)
    yield alpha(m.ParticleCloud, poses=range(6), weights=[0.25, 0.75])
    yield alpha(m.Innovation, squared=20.5, dof=22)
    yield alpha(
        m.Trajectory,
        stamps=[9_000],
        poses=ALPHA["pose"],
        covariances=spd(3),
        start=[0.5, 0.25, 0.125],
        start_covariance=spd(3),
        crosses=range(9),
    )
    yield alpha(m.Rendezvous, teammates=("bravo",), submaps=3, waited_s=12.5)
    ledger = (m.Disposition(disposition="in a submap", measurements=200),)
    yield alpha(m.Done, steps=99, submaps=20, ledger=ledger, last_map=7)


def examples() -> Iterator[m.Message]:
    yield from measured_examples()
    yield from peers_examples()
    yield from map_examples()
    yield from robot_examples()
    yield alpha(m.Configuration, stamp_ns=0, configuration='{"seed": 7}')
    yield alpha(m.Withdrawal)
    same = m.Judgement(first=place(3, 5), second=place(8, 0, "beta"), same=True)
    yield alpha(m.Verdict, stamp_ns=0, judgement=same, reason="the same tree")
    yield alpha(m.WithdrawalHeard, withdrawn="bravo")
    yield alpha(m.Progress, node="central", measurements=128, submaps=6)
    yield alpha(m.End, streams=(alpha(m.StreamEnd),), notes=("gap of 3 s",))
    yield alpha(m.StreamHead)
    yield build.team_end(reason="the batteries are empty")
    yield alpha(
        m.Status,
        node="recorder",
        state="recording",
        figures={"messages": 12.0},
        warnings=("slow disk",),
        run="0123456789abcdef",
    )
    yield alpha(m.GivenUp, reason="it fell into the water")
    yield alpha(
        m.KeptRequest, stamp_ns=0, node="robot/alpha", channels=("final_map",), run_ns=5_000_000_000
    )
    yield alpha(m.Kept, key="central/final", payload=b"\x91\xc0", wall_ns=10**18)
    yield m.FoldRequest(stamp_ns=0)
    yield alpha(
        m.Fault,
        node="central",
        origin="robot/alpha/submap",
        count=7,
        message="submap/1",
        error="ValueError",
        text="no frame",
        place="central.node:CentralNode.handle:58",
        digest=bytes(range(1, 9)),
    )
    yield alpha(m.Liveliness, stamp_ns=0)
    yield alpha(m.Tally, since_ns=10**18, keys=("robot/alpha/submap",), counts=(6,))
    yield alpha(m.MeasurementsRequest, stamp_ns=0, first=5)
    yield alpha(m.SubmapsRequest, stamp_ns=0)


K = TypeVar("K", bound=m.Message)


def example(kind: type[K], **fields: object) -> K:
    found = next(each for each in examples() if isinstance(each, kind))
    return msgspec.structs.replace(found, **fields)


fused_map = partial(build.fused_map, joint=False, ids=b"", means=b"", covariance=b"")
"""A map of the rule `join` in r1's frame, empty unless these fields are given."""
