"""FastSLAM on arrays: a robot drives a circle among eight landmarks.

python examples/fastslam.py [PICTURE]
"""

import sys

import numpy as np

from team import (
    Keyframe,
    MotionModel,
    MotionNoise,
    Sensor,
    compose,
    fastslam_step,
    increment_of,
    measurement_of,
    particles_at,
)  # fmt: skip

rng = np.random.default_rng(1)
sensor = Sensor(range_sigma=0.1, bearing_sigma=0.02)
motion = MotionModel(forward=MotionNoise(per_m=0.05), turn=MotionNoise(per_rad=0.05))
landmarks = rng.uniform((-7.0, -3.0), (7.0, 11.0), (8, 2))
pose, particles = np.zeros(3), particles_at(np.zeros((100, 3)))
path, estimated = [], []
for _ in range(60):  # a keyframe each second: half a metre and an eighth of a radian
    increment = increment_of(motion, duration_s=1.0, forward=0.5, yaw_rate=0.125)
    noise = rng.normal(0.0, (0.05 * np.sqrt(0.5), 0.0, 0.05 * np.sqrt(0.125)))
    pose = compose(pose, increment.mean + noise)
    true = np.array([measurement_of(pose, landmark) for landmark in landmarks])
    measured = true + rng.normal(0.0, (0.1, 0.02), true.shape)
    seen = np.flatnonzero(true[:, 0] < 6.0)
    keyframe = Keyframe(
        increment=increment, ids=seen.astype(np.uint32),
        ranges=measured[seen, 0], bearings=measured[seen, 1],
    )  # fmt: skip
    particles, info = fastslam_step(particles, keyframe, sensor, rng)
    path.append(pose)
    estimated.append(np.exp(particles.log_weights) @ particles.poses[:, :2])

means = np.tensordot(np.exp(particles.log_weights), particles.means, 1)
errors = np.linalg.norm(means - landmarks[particles.ids], axis=1)
print(f"{len(particles.ids)} landmarks, RMSE {np.sqrt(np.mean(errors**2)):.3f} m")

if len(sys.argv) > 1:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 7), layout="constrained")
    axes = figure.subplots()
    axes.plot(*np.array(path).T[:2], color="gray", label="true path")
    axes.plot(*np.array(estimated).T, "C0-", label="FastSLAM")
    axes.plot(*landmarks.T, "rx", label="true landmarks")
    axes.plot(*means.T, "k.", label="landmarks of the map")
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    figure.legend(loc="outside lower center", ncols=2)
    figure.savefig(sys.argv[1])
