"""The boundary of the core checks its inputs; a refused one changes nothing.

Results of a window are tested in tests/estimation/hybrid_slam.
"""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from teamslam.team import core

NOISE = (0.04, 0.001, 1.0, 0.003, 1.0)
CONSTANT = (0.04, 0.001, 0.5, 0.003, 0.7)
MOTION, COVARIANCE = np.array([1.0, 0.0, 0.1]), np.diag([0.01, 1e-4, 1e-3])
M = 20
RNG = np.random.default_rng(7)
KEY = b"a key of 16 byte"
NORMALS = core.Random(KEY).normals(M, 3)
IDS, RANGES, BEARINGS = np.array([3, 1], np.uint32), np.array([5.0, 9.0]), np.array([0.3, -1.0])
UNCLAIMED = np.empty((2, 0))
KEYFRAME = (MOTION, COVARIANCE, IDS, RANGES, BEARINGS, UNCLAIMED)


def keyframe_of(mean, covariance, *scan: object) -> core.Keyframe:
    return core.Keyframe(0, (mean, covariance), core.Scan(*scan))


def opened(keyframes: int = 2, noise: tuple[float, ...] = NOISE) -> core.Window:
    window = core.Window(M, noise)
    for _ in range(keyframes):
        advance(window)
    return window


def advance(window: core.Window, keyframe: tuple[object, ...] = KEYFRAME) -> core.Step:
    """Take a keyframe with the same random numbers as any other."""
    return window.advance(keyframe_of(*keyframe), core.Random(KEY))


def bytes_of(window: core.Window) -> list[bytes]:
    arrays = (
        *window.particles(),
        window.paths(),
        *window.measurements(),
        window.nodes(),
        *window.close()[:3],
    )
    return [array.tobytes() for array in arrays]


def changed(place: int, value: object) -> tuple[object, ...]:
    return *KEYFRAME[:place], value, *KEYFRAME[place + 1 :]


WRONG = {
    "a motion of two numbers": (0, MOTION[:2]),
    "a covariance of a row": (1, COVARIANCE[:1]),
    "ids that are signed": (2, np.array([-3, 1])),
    "an id too few": (2, IDS[:1]),
    "a range too many": (3, np.ones(3)),
    "a bearing too few": (4, BEARINGS[:1]),
    "claims of three columns": (5, np.ones((2, 3))),
    "a claim too few": (5, np.ones((1, 4))),
    "text": (3, "ranges"),
}


@pytest.mark.parametrize("name", WRONG)
def test_an_array_of_another_shape_or_type_is_refused(name):
    window = opened()
    kept = bytes_of(window)
    with pytest.raises((ValueError, TypeError)):
        advance(window, changed(*WRONG[name]))
    assert bytes_of(window) == kept


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize(
    ("place", "error"),
    [(0, core.MotionError), (1, core.MotionError), (3, core.NotFiniteError),
     (4, core.NotFiniteError)],
)  # fmt: skip
def test_a_number_that_is_not_finite_is_refused(place, error, bad):
    window = opened()
    kept = bytes_of(window)
    array = np.array(KEYFRAME[place])
    array[-1] = bad
    with pytest.raises(error):
        advance(window, changed(place, array))
    assert bytes_of(window) == kept


@pytest.mark.parametrize("is_redrawn", [False, True])
def test_landmarks_solved_at_earlier_keyframes_are_those_that_are_solved_at_the_end(is_redrawn):
    rng = np.random.default_rng(3)
    asked, unasked = (core.Window(M, CONSTANT, resample_below=0.8) for _ in range(2))
    for _ in range(12):
        ids = np.flatnonzero(rng.random(5) < 0.5).astype(np.uint32)
        n = len(ids)
        seen = ids, rng.uniform(2.0, 9.0, n), rng.uniform(-1.0, 1.0, n), np.empty((n, 0))
        for window in (asked, unasked):
            advance(window, (MOTION, COVARIANCE, *seen))
        asked.run()
    for window in (asked, unasked) if is_redrawn else ():
        _, logs, _, means, covariances = window.particles()
        window.replace(np.ascontiguousarray(window.paths()[:, ::-1]), logs, means, covariances)
    assert bytes_of(asked) == bytes_of(unasked)


@pytest.mark.parametrize("place", [0, 2, 3, 4])
def test_a_sensor_without_noise_or_white_noise_is_refused(place):
    noise = (*NOISE[:place], 0.0, *NOISE[place + 1 :])
    with pytest.raises(ValueError, match="of the sensor must be"):
        core.Window(M, noise)


def test_the_window_of_a_mounted_sensors_base_neither_advances_nor_closes():
    window = core.Window(M, NOISE, mount=(0.3, 0.1, 0.7))
    advance(window)
    based = window.of_base()
    for use in (
        based.close,
        based.run,
        lambda: based.sensitivity(np.zeros(7), False),
        lambda: advance(based),
    ):
        with pytest.raises(ValueError, match="no measurements of its own"):
            use()


def test_a_window_of_particles_goes_on_as_the_one_they_come_from():
    window = opened()
    again = core.Window.of_particles(*window.particles(), NOISE)
    log = again.step(keyframe_of(*KEYFRAME), NORMALS)
    assert advance(window).log_evidence == log
    for one, other in zip(window.particles(), again.particles(), strict=True):
        np.testing.assert_array_equal(one, other)


def test_particles_that_do_not_fit_each_other_are_refused():
    poses, logs, ids, means, covariances = opened().particles()
    fitting = poses, logs, ids, means, covariances
    for place, wrong in enumerate(
        (poses[:-1], logs[:-1], ids[:-1], means[:, :1], covariances[:-1])
    ):
        with pytest.raises(ValueError, match="must be"):
            core.Window.of_particles(*fitting[:place], wrong, *fitting[place + 1 :], NOISE)
    with pytest.raises(ValueError, match="ids must differ"):
        core.Window.of_particles(poses, logs, np.full(2, 3, np.uint32), means, covariances, NOISE)
    with pytest.raises(ValueError, match="M > 0"):
        core.Window.of_particles(
            *(each[:0] for each in (poses, logs)), ids[:0], means[:0], covariances[:0], NOISE
        )
    with pytest.raises(core.NotFiniteError):
        core.Window.of_particles(poses, logs + np.inf, ids, means, covariances, NOISE)


def test_a_pose_node_needs_a_keyframe_and_a_keyframe_of_a_measurement_a_path():
    with pytest.raises(IndexError):
        core.Window(M, NOISE).mark(0)
    window = opened()
    keyframes, seen, measurements, own = window.measurements()
    _, _, ids, means, covariances = window.particles()
    solved = (ids, means, covariances, window.paths())
    core.landmarks_along_paths(*solved, keyframes, seen, measurements, own, NOISE)
    for wrong in (keyframes + 1, keyframes - 1):
        with pytest.raises(ValueError, match="not in the paths"):
            core.landmarks_along_paths(*solved, wrong, seen, measurements, own, NOISE)


@settings(deadline=None, max_examples=60)
@given(
    st.integers(1, 40), st.integers(0, 2**32 - 1), st.booleans(), st.sampled_from([NOISE, CONSTANT])
)
def test_windows_of_any_size_run_and_close(count, seed, improved, noise):
    """Random sizes, ids and claims, for sanitizers to find reads out of bounds."""
    rng = np.random.default_rng(seed)
    mount = (0.1, 0.2, 0.3) if seed % 2 else (0.0, 0.0, 0.0)
    window, random = core.Window(count, noise, improved, mount, 0.5), core.Random(KEY)
    for k in range(int(rng.integers(0, 5))):
        n = int(rng.integers(0, 6))
        own = np.column_stack((np.tile([0.1, 0.001, 0.02], (n, 1)), rng.integers(-1, 2, n)))
        seen = keyframe_of(
            MOTION, COVARIANCE, rng.integers(0, 5, n).astype(np.uint32), rng.uniform(0.0, 20.0, n),
            rng.uniform(-3.0, 3.0, n), own if seed % 3 else own[:, :0],
        )  # fmt: skip
        window.advance(seen, random)
        if k % 2:
            window.mark(k)
        window.run()
    ids, mean, covariance, _ = window.close()
    assert (np.diff(ids.astype(np.int64)) > 0).all()
    assert covariance.shape == (len(mean), len(mean))
    assert (
        len(mean)
        == 3 + 3 * len(window.nodes()) + 2 * len(ids)
        == 3 + 3 * len(window.nodes()) + 2 * window.landmarks
    )
    based, weights = window.of_base(), np.exp(window.particles()[1])
    assert len(based.paths()) == window.keyframes == len(window.mean_path())
    assert np.isclose(weights.sum(), 1.0)
