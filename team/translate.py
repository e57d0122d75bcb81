"""Convert estimation values to messages and back: the only module that imports both."""

from collections.abc import Sequence
from typing import Any, TypeVar

import msgspec
import numpy as np

from teamslam.team.config import RobotConfig
from teamslam.team.core import OdometryInterval, Scan, packed, unpacked
from teamslam.team.estimation.contribution import (
    NO_OWN,
    Contribution,
    InitialPoseFactor,
    OwnBiases,
    RobotBias,
    Stream,
)
from teamslam.team.estimation.dense import diagonal_blocks
from teamslam.team.estimation.gaussian import LandmarkGaussian, Matrix
from teamslam.team.estimation.inter_robot import BASE, CarriedPoint, InterRobotFactor
from teamslam.team.estimation.map_joining.conditioning import RobotPrior, SubmapCorrection
from teamslam.team.estimation.models import steered
from teamslam.team.estimation.se2 import logarithm
from teamslam.team.estimation.submap import NO_COLUMNS, NONE_UNNAMED, LocalMap, Unnamed
from teamslam.team.shapes import Float, UInt32
from teamslam.team.wire import messages as m
from teamslam.team.wire.arrays import (
    derivatives,
    floats,
    from_derivatives,
    from_floats,
    from_ids,
    from_stamps,
    ids,
    landmark_blocks,
    octets,
    stamps,
)
from teamslam.team.wire.codec import find_error


def frame_name(robot: str, incarnation: int) -> str:
    """Name the frame that the start of a stream fixes."""
    return f"{robot}/{incarnation}"


def pose_of(message: m.InitialPose) -> tuple[Float[np.ndarray, "3"] | None, Matrix | None]:
    """Read the initial pose (None: unknown) and its covariance (None: exactly known)."""
    pose = floats(message.pose, "pose").copy() if message.pose else None
    P = floats(message.covariance, "covariance").reshape(-1, 3).copy()
    return pose, P if message.covariance else None


def start_of(message: m.InitialPose) -> InitialPoseFactor | None:
    """Read the initial pose as a factor of map joining; None for an unknown pose."""
    pose, covariance = pose_of(message)
    if pose is None:
        return None
    return InitialPoseFactor(message.robot, message.incarnation, pose, covariance)


def scan_of(message: m.AnyScan | m.Detections) -> Scan:
    """Read the observed landmarks; points become range and bearing.

    Detections without identities have the numbers 2³¹ + their index in the message, until their
    window associates them.
    """
    own = message.covariances
    match message:
        case m.Observations():
            return Scan.polar(message.ids, message.ranges, message.bearings, own)
        case m.Points():
            return Scan.points(message.ids, message.positions, own)
        case m.Detections():
            return Scan.unnamed(message.ranges, message.bearings, own)


def team_time_of(message: m.Measurement, clock_offset_s: float) -> int:
    """Compute a measurement's team time [ns]; for an odometry interval that of its end."""
    offset_s = clock_offset_s if isinstance(message, m.AnyOdometry) else 0.0
    return message.stamp_ns + round(offset_s * 1e9)


def interval_of(message: m.AnyOdometry, config: RobotConfig) -> OdometryInterval:
    """Read one odometry interval for the robot's motion model."""
    end_ns = message.stamp_ns + round(config.clock_offset_s * 1e9)
    duration_ns = message.duration_ns
    match message:
        case m.Odometry():
            return OdometryInterval(end_ns, duration_ns, message.forward, message.yaw_rate)
        case m.Steering():
            speeds = steered(config.motion, message.wheel_speed, message.steering)
            return OdometryInterval(end_ns, duration_ns, *speeds)
        case m.Increment():
            covariance = floats(message.covariance, "covariance").astype(np.float64).reshape(-1, 3)
            increment = floats(message.increment, "increment").astype(np.float64)
            twist = logarithm(increment)
            rates = twist / max(duration_ns * 1e-9, 1e-9)
            own = covariance if message.covariance else None
            return OdometryInterval(
                end_ns, duration_ns, float(rates[0]), float(rates[2]), twist, own
            )


def detections_of(
    message: m.Sightings,
) -> tuple[tuple[str, ...], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Read (teammates, ranges [m], bearings [rad])."""
    return (
        message.teammates,
        floats(message.ranges, "ranges").astype(np.float64),
        floats(message.bearings, "bearings").astype(np.float64),
    )


def submap_message(
    robot: str,
    incarnation: int,
    sequence: int,
    measurements: tuple[int, int],
    span_ns: tuple[int, int],
    config: bytes,
    local: LocalMap,
    sightings: int = 0,
    gated: int = 0,
) -> m.Submap:
    """Make the message of a local map."""
    return m.Submap(
        stamp_ns=span_ns[1],
        robot=robot,
        incarnation=incarnation,
        sequence=sequence,
        first_measurement=measurements[0],
        last_measurement=measurements[1],
        start_ns=span_ns[0],
        config=config,
        ids=from_ids(local.ids),
        mean=from_floats(local.mean),
        covariance=from_floats(packed(local.covariance)),
        nodes=from_stamps(local.node_stamps),
        sightings=sightings,
        biases=local.biases,
        sensitivity=from_derivatives(local.sensitivity),
        curvature=from_derivatives(local.curvature[local.biases.index("clock_offset")])
        if "clock_offset" in local.biases
        else b"",
        gated=gated,
        counts=from_ids(local.unnamed.counts),
        seen=np.packbits(local.unnamed.seen, axis=1, bitorder="little").tobytes(),
        keyframes=local.unnamed.seen.shape[1],
        classes=from_floats(local.unnamed.classes),
    )


def local_map_of(message: m.Submap) -> LocalMap:
    """Read the local map of a submap message."""
    mean = floats(message.mean, "mean").astype(np.float64)
    return LocalMap(
        ids(message.ids, "ids").astype(np.uint32),
        mean,
        unpacked(floats(message.covariance, "covariance"), len(mean)),
        stamps(message.nodes, "nodes").astype(np.int64),
        message.biases,
        _sensitivity_of(message),
        _unnamed_of(message),
        _curvature_of(message),
    )


def _unnamed_of(message: m.Submap) -> Unnamed:
    if not message.counts and not message.keyframes:
        return NONE_UNNAMED
    counts = ids(message.counts, "counts").astype(np.uint32)
    rows = octets(message.seen, "seen").reshape(len(counts), -(-message.keyframes // 8))
    seen = np.unpackbits(rows, axis=1, count=message.keyframes, bitorder="little")
    return Unnamed(counts, seen.astype(np.bool_), classes_of(message, len(counts)))


def classes_of(message: m.Submap | m.Detections, count: int) -> Float[np.ndarray, "n C"]:
    """Read the evidence of the classes of `count` landmarks or detections."""
    found = floats(message.classes, "classes").astype(np.float64)
    return found.reshape(count, -1) if count and len(found) else np.empty((count, 0))


def _sensitivity_of(message: m.Submap) -> Float[np.ndarray, "B n"]:
    if not message.biases:
        return NO_COLUMNS
    count = len(message.biases) * len(message.mean) // 8
    rows = derivatives(message.sensitivity, count, "sensitivity")
    return rows.reshape(len(message.biases), -1)


def _curvature_of(message: m.Submap) -> Float[np.ndarray, "B n"]:
    if not message.biases:
        return NO_COLUMNS
    if not message.curvature:
        return np.zeros((len(message.biases), len(message.mean) // 8))
    row = derivatives(message.curvature, len(message.mean) // 8, "curvature")
    return np.array([row * (bias == "clock_offset") for bias in message.biases])


def sighting_of(message: m.SightingFactor) -> InterRobotFactor:
    """Read the inter-robot factor of map joining."""
    return InterRobotFactor(
        message.robot,
        message.incarnation,
        message.sequence,
        message.stamp_ns,
        message.teammate,
        np.array([message.range, message.bearing]),
        unpacked(floats(message.covariance, "covariance"), 2),
        floats(message.point, "point").astype(np.float64) if message.point else BASE,
    )


def fix_of(message: m.Fix, config: RobotConfig) -> CarriedPoint:
    """Read the position [m] and the covariance [m²] of a fix."""
    own = message.covariance
    P = unpacked(floats(own, "covariance"), 2) if own else config.gnss.sigma_m**2 * np.eye(2)
    return CarriedPoint(floats(message.position, "position").astype(np.float64), P)


def contribution_of(message: m.Submap) -> Contribution:
    """Read the submap as a contribution to map joining."""
    stream = message.robot, message.incarnation
    return Contribution(*stream, message.sequence, message.stamp_ns, local_map_of(message))


def own_biases_of(saved: m.SavedMap) -> OwnBiases:
    """Read the errors of single robots in a saved map."""
    K = len(saved.own)
    if not K:
        return NO_OWN
    return OwnBiases(
        tuple(RobotBias(each.robot, each.bias) for each in saved.own),
        floats(saved.own_means, "own_means").astype(np.float64),
        unpacked(floats(saved.own_covariance, "own_covariance"), K),
        floats(saved.own_cross, "own_cross").astype(np.float64).reshape(K, -1),
        floats(saved.own_sensitivity, "own_sensitivity").astype(np.float64).reshape(-1, K),
        floats(saved.likeliest, "likeliest").astype(np.float64),
        unpacked(floats(saved.evidence, "evidence"), K + len(saved.biases)),
    )


def joint_bytes(covariance: Matrix) -> bytes:
    """Pack the upper triangle of a joint covariance."""
    return from_floats(packed(covariance))


def block_bytes(blocks: Float[np.ndarray, "L 2 2"]) -> bytes:
    """Pack the upper triangles of L 2 × 2 blocks."""
    return from_floats(blocks[:, [0, 0, 1], [0, 1, 1]])


def covariance_bytes(covariance: Matrix, *, joint: bool) -> bytes:
    """Pack a landmark covariance: the joint one, or each landmark's own block."""
    return joint_bytes(covariance) if joint else block_bytes(diagonal_blocks(covariance))


def landmark_covariance_of(message: m.MapEstimate | m.FusedMap) -> Matrix:
    """Return the joint 2L × 2L covariance; block-diagonal where the message has blocks only."""
    n = len(ids(message.ids, "ids"))
    values = floats(message.covariance, "covariance")
    if message.joint:
        return unpacked(values, 2 * n)
    joint = np.zeros((n, 2, n, 2))
    joint[np.arange(n), :, np.arange(n), :] = landmark_blocks_of(message)
    return joint.reshape(2 * n, 2 * n)


def landmark_blocks_of(message: m.MapEstimate | m.FusedMap) -> Float[np.ndarray, "L 2 2"]:
    """Return the 2 × 2 covariance of each landmark."""
    return landmark_blocks(message.covariance, len(message.ids) // 4, joint=message.joint)


LandmarkMap = TypeVar("LandmarkMap", m.MapEstimate, m.FusedMap)
NAMED = 10  # number of omitted landmarks that are named


def make_receivable(message: LandmarkMap) -> tuple[LandmarkMap, tuple[str, ...]]:
    """Reduce the map to a form that every receiver accepts; describe the omissions.

    A joint covariance lost to rounding is replaced by the landmarks' own; a landmark with an
    invalid covariance or mean is omitted.
    """
    warnings = []
    if message.joint and find_error(message) is not None:
        warnings.append("the joint covariance is lost to rounding: each landmark has its own only")
        blocks = block_bytes(landmark_blocks_of(message))
        message = msgspec.structs.replace(message, joint=False, covariance=blocks)
    if find_error(message) is not None:
        message, left_out = _with_sound_landmarks(message)
        warnings.append(f"left out, their covariance is none: {', '.join(map(str, left_out))}")
    return message, tuple(warnings)


def _with_sound_landmarks(message: LandmarkMap) -> tuple[LandmarkMap, list[int]]:
    landmark_ids, means = landmarks_of(message)
    blocks = landmark_blocks_of(message)
    a, b, c = blocks[:, 0, 0], blocks[:, 0, 1], blocks[:, 1, 1]
    with np.errstate(all="ignore"):
        sound = np.isfinite(means).all(axis=1) & np.isfinite(blocks).all(axis=(1, 2))
        sound &= (a > 0.0) & (c > 0.0) & (np.abs(b) < np.sqrt(a) * np.sqrt(c))
    remaining = msgspec.structs.replace(
        message,
        ids=from_ids(landmark_ids[sound]),
        means=from_floats(means[sound]),
        covariance=block_bytes(blocks[sound]),
    )
    return remaining, landmark_ids[~sound][:NAMED].tolist()


def landmarks_of(
    message: m.MapEstimate | m.FusedMap | m.TruthLandmarks | m.KnownMap,
) -> tuple[UInt32[np.ndarray, " L"], Float[np.ndarray, "L 2"]]:
    """Read identities and positions [m] of a map message."""
    values = message.positions if isinstance(message, m.LandmarkPositions) else message.means
    return (
        ids(message.ids, "ids").astype(np.uint32),
        floats(values, "means").astype(np.float64).reshape(-1, 2),
    )


def _prior(fused: m.FusedMap, stream: Stream, **fields: Any) -> m.Prior:
    robot, incarnation = stream
    return m.Prior(
        stamp_ns=fused.stamp_ns,
        robot=robot,
        incarnation=incarnation,
        digest=fused.digest,
        members=fused.members,
        heard=fused.heard,
        withdrawn=len(fused.withdrawn),
        **fields,
    )


def prior_message(fused: m.FusedMap, stream: Stream, sequence: int, prior: RobotPrior) -> m.Prior:
    """Make the prior of a robot in the team's map, up to its submap `sequence`."""
    robot, incarnation = stream
    biases = (
        m.BiasEstimate(robot=robot, incarnation=incarnation, bias=bias, value=value, sigma=sigma)
        for bias, value, sigma in prior.shared.biases
    )
    return _prior(
        fused,
        stream,
        sequence=sequence,
        ids=from_ids(prior.ids),
        mean=from_floats(np.concatenate((prior.pose, prior.means.ravel()))),
        covariance=joint_bytes(prior.covariance),
        covariance_factor=prior.shared.covariance_factor,
        biases=tuple(biases),
        frame=fused.frame,
    )


def prior_of(message: m.Prior) -> RobotPrior:
    """Read the prior; one of landmarks alone has the pose zero."""
    mean = floats(message.mean, "mean").astype(np.float64)
    covariance = unpacked(floats(message.covariance, "covariance"), len(mean))
    if not message.in_team_frame:
        mean, covariance = np.pad(mean, (3, 0)), np.pad(covariance, (3, 0))
    landmark_ids = ids(message.ids, "ids").astype(np.uint32)
    biases = tuple((each.bias, each.value, each.sigma) for each in message.biases)
    shared = SubmapCorrection(message.covariance_factor, biases)
    return RobotPrior(mean[:3], landmark_ids, mean[3:].reshape(-1, 2), covariance, shared)


def landmark_prior_message(
    fused: m.FusedMap,
    stream: Stream,
    landmarks: LandmarkGaussian,
    frame: Stream | None,
    covariance_factor: float = 1.0,
) -> m.Prior:
    """Make the prior of a robot outside the team's map: landmarks in a frame, or an empty one."""
    of_team = frame is not None and len(landmarks.ids) > 0
    return _prior(
        fused,
        stream,
        sequence=-1,
        ids=from_ids(landmarks.ids),
        mean=from_floats(landmarks.means.ravel()),
        covariance=joint_bytes(landmarks.covariance) if of_team else b"",
        covariance_factor=covariance_factor,
        frame=frame_name(*(frame if of_team and frame else stream)),
        in_team_frame=False,
    )


def trajectory_message(
    stream: Stream,
    digest: bytes,
    pose_stamps: Sequence[int],
    poses: Float[np.ndarray, "K 3"],
    covariances: Float[np.ndarray, "K 3 3"],
    **start: bytes,
) -> m.Trajectory:
    """Make the message of the smoothed ends of submaps; start: its optional fields."""
    robot, incarnation = stream
    symmetric = 0.5 * (covariances + covariances.transpose(0, 2, 1))
    return m.Trajectory(
        stamp_ns=pose_stamps[-1],
        robot=robot,
        incarnation=incarnation,
        digest=digest,
        stamps=from_stamps(pose_stamps),
        poses=from_floats(poses),
        covariances=from_floats(symmetric),
        **start,
    )


def trajectory_of(
    message: m.Trajectory | m.Truth,
) -> tuple[np.ndarray, Float[np.ndarray, "K 3"]]:
    """Read (stamps_ns, poses) of a smoothed or a true trajectory."""
    return (
        stamps(message.stamps, "stamps").astype(np.int64),
        floats(message.poses, "poses").astype(np.float64).reshape(-1, 3),
    )
