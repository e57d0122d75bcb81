import hashlib

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from teamslam.team import translate
from teamslam.team.config import UNNAMED, RobotConfig
from teamslam.team.estimation.dense import diagonal_blocks
from teamslam.team.estimation.gaussian import PoseGaussian
from teamslam.team.estimation.hybrid_slam.pose_grid import NodeSighting
from teamslam.team.estimation.map_joining.conditioning import RobotPrior, SubmapCorrection
from teamslam.team.estimation.submap import LocalMap, Unnamed
from teamslam.team.robot.statements import MessageWriter
from teamslam.team.wire.arrays import from_floats
from teamslam.team.wire.codec import decoded, encoded
from teamslam.team.wire.digest import announce_configuration, digest_of
from tests import build
from tests.estimation.submap_world import correlated


def local_map(ids, seed):
    rng = np.random.default_rng(seed)
    n = 3 + 2 * len(ids)
    numbers = np.array(sorted(ids), np.uint32)
    unnamed = np.count_nonzero(numbers >= UNNAMED)
    counts = rng.integers(1, 9, unnamed).astype(np.uint32)
    seen = rng.random((unnamed, seed)) < 0.5
    return LocalMap(
        numbers, rng.normal(size=n), correlated(np.ones(n), rng), unnamed=Unnamed(counts, seen)
    )


def over_the_wire(message):
    return decoded(encoded(message), type(message))


@settings(deadline=None, max_examples=30)
@given(st.sets(st.integers(0, 2**32 - 1), max_size=6), st.integers(0, 99))
def test_a_submap_survives_the_wire_bit_for_bit(ids, seed):
    local = local_map(ids, seed)
    message = translate.submap_message("r1", 2, 5, (10, 19), (1_000, 2_000), b"settings", local)
    there = over_the_wire(message)
    found = translate.local_map_of(there)
    assert found.ids.tobytes() == local.ids.tobytes()
    assert found.mean.tobytes() == local.mean.tobytes()
    assert found.covariance.tobytes() == local.covariance.tobytes()
    assert (found.unnamed.counts == local.unnamed.counts).all()
    assert np.array_equal(found.unnamed.seen, local.unnamed.seen)
    again = translate.submap_message("r1", 2, 5, (10, 19), (1_000, 2_000), b"settings", found)
    assert encoded(again) == encoded(message)
    assert (there.first_measurement, there.last_measurement) == (10, 19)
    assert (there.start_ns, there.stamp_ns) == (1_000, 2_000)
    assert translate.contribution_of(there).key == (2_000, "r1", 2, 5)


def test_pose_nodes_and_sightings_survive_the_wire_bit_for_bit():
    rng = np.random.default_rng(3)
    nodes = np.array([1_200, 1_700])
    local = LocalMap(
        np.array([4], np.uint32), rng.normal(size=11), correlated(np.ones(11), rng), nodes
    )
    span_ns = (1_000, 2_000)
    message = translate.submap_message("r1", 2, 5, (1, 9), span_ns, b"settings", local, sightings=1)
    there = over_the_wire(message)
    found = translate.local_map_of(there)
    assert there.sightings == 1
    assert found.node_stamps.tolist() == [1_200, 1_700]
    assert found.nodes.tobytes() == local.mean[3:9].tobytes()
    assert found.landmarks.tobytes() == local.mean[9:].tobytes()
    seen = NodeSighting(1_200, "r2", np.array([2.0, -1.0]), correlated(np.ones(2), rng), (3, 4))
    writer = MessageWriter("r1", 2, b"settings", started=True)
    message = over_the_wire(writer.sighting(5, seen))
    assert message.measurements == (3, 4)
    again = translate.sighting_of(message)
    assert (again.stream, again.sequence, again.stamp_ns) == (("r1", 2), 5, 1_200)
    assert again.teammate == "r2"
    assert again.measurement.tobytes() == seen.measurement.tobytes()
    assert again.covariance.tobytes() == seen.covariance.tobytes()


@settings(deadline=None, max_examples=20)
@given(st.sets(st.integers(1, 50), max_size=5), st.integers(0, 99))
def test_a_prior_survives_the_wire_bit_for_bit(ids, seed):
    local = local_map(ids, seed)
    shared = SubmapCorrection(2.5, (("bearing", 0.01, 0.001), ("range_scale", -0.02, 0.003)))
    prior = RobotPrior(local.end_pose, local.ids, local.landmarks, local.covariance, shared)
    fused = build.fused_map(digest=b"its name", means=b"")
    there = over_the_wire(translate.prior_message(fused, ("r1", 1), 3, prior))
    found = translate.prior_of(there)
    for value, expected in zip(found[:-1], prior[:-1], strict=True):
        assert value.tobytes() == np.ascontiguousarray(expected).tobytes()
    assert found.shared == shared
    assert (there.sequence, there.digest, there.frame) == (3, b"its name", "r1/1")


@pytest.mark.parametrize("covariance", [None, np.diag([0.25, 0.5, 0.125])])
def test_a_start_is_known_exactly_or_with_a_covariance(covariance):
    spread = b"" if covariance is None else from_floats(covariance)
    start = translate.start_of(build.initial_pose(pose=[1.0, 2.0, 3.0], covariance=spread))
    np.testing.assert_array_equal(start.pose, [1.0, 2.0, 3.0])
    np.testing.assert_equal(start.covariance, covariance)
    assert start.stream == ("r1", 1)


def estimate(covariance, *, joint):
    return build.map_estimate(joint=joint, ids=[3, 9], means=np.arange(4.0), covariance=covariance)


def test_a_map_carries_its_joint_covariance_or_the_blocks_of_it():
    joint = correlated(np.array([1.0, 2.0, 3.0, 4.0]), np.random.default_rng(1))
    whole = over_the_wire(estimate(translate.joint_bytes(joint), joint=True))
    np.testing.assert_array_equal(translate.landmark_covariance_of(whole), joint)
    blocks = diagonal_blocks(joint)
    np.testing.assert_array_equal(blocks[1], joint[2:, 2:])
    parts = over_the_wire(estimate(translate.block_bytes(blocks), joint=False))
    found = translate.landmark_covariance_of(parts)
    np.testing.assert_array_equal(diagonal_blocks(found), blocks)
    assert not found[:2, 2:].any()
    ids, means = translate.landmarks_of(whole)
    assert ids.tolist() == [3, 9]
    np.testing.assert_array_equal(means, [[0.0, 1.0], [2.0, 3.0]])


def test_a_pose_passes_the_door_although_rounding_made_it_skew():
    covariance = np.diag([1.0, 2.0, 3.0])
    covariance[0, 1] = 1e-17
    writer = MessageWriter("r1", 1, b"settings", started=False)
    message = writer.pose(1, 2, PoseGaussian(np.zeros(3), covariance)).message
    assert over_the_wire(message) == message


def test_a_trajectory_comes_back_with_its_stamps():
    poses = np.arange(6.0).reshape(2, 3)
    covariances = np.stack([np.eye(3), 2.0 * np.eye(3)])
    message = over_the_wire(
        translate.trajectory_message(("r1", 1), bytes(8), [10, 20], poses, covariances)
    )
    stamps_ns, found = translate.trajectory_of(message)
    assert stamps_ns.tolist() == [10, 20]
    np.testing.assert_array_equal(found, poses)


def test_the_digest_is_that_of_the_announced_text_and_tells_its_parts_apart():
    announced = announce_configuration("robot/r1", 0, 0, RobotConfig("r1"))
    text = announced.configuration.encode()
    by_hand = hashlib.blake2b(len(text).to_bytes(8, "little") + text, digest_size=8).digest()
    assert announced.digest == by_hand
    assert digest_of(b"ab", b"c") != digest_of(b"a", b"bc")
    assert digest_of(b"a", b"") != digest_of(b"a")
