"""Run FastSLAM on arrays: a robot drives a circle among eight landmarks.

python examples/fastslam.py [PICTURE]
"""

import sys

import numpy as np

import teamslam

rng = np.random.default_rng(1)
sensor = teamslam.Sensor(range_sigma=0.1, bearing_sigma=0.02)
motion = teamslam.MotionModel(
    forward=teamslam.MotionNoise(per_m=0.05), turn=teamslam.MotionNoise(per_rad=0.05)
)
landmarks = rng.uniform((-7.0, -3.0), (7.0, 11.0), (8, 2))
path, particles = [np.zeros(3)], teamslam.particles_at(np.zeros((100, 3)))
for _ in range(60):  # a keyframe each second: half a metre and an eighth of a radian
    increment = teamslam.increment_of(motion, duration_s=1.0, forward=0.5, yaw_rate=0.125)
    moved = rng.multivariate_normal(increment.mean, increment.covariance)
    path.append(teamslam.compose(path[-1], moved))
    true = np.array([teamslam.measurement_of(path[-1], landmark) for landmark in landmarks])
    seen = np.flatnonzero(true[:, 0] < 6.0).astype(np.uint32)
    ranges, bearings = (true + rng.normal(0.0, (0.1, 0.02), true.shape))[seen].T
    keyframe = teamslam.Keyframe(increment=increment, ids=seen, ranges=ranges, bearings=bearings)
    particles, info = teamslam.fastslam_step(particles, keyframe, sensor, rng)

means = np.tensordot(np.exp(particles.log_weights), particles.means, 1)
errors = np.linalg.norm(means - landmarks[particles.ids], axis=1)
print(f"{len(particles.ids)} landmarks, RMSE {np.sqrt(np.mean(errors**2)):.3f} m")

if len(sys.argv) > 1:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 7), layout="constrained")
    axes = figure.subplots()
    axes.plot(*np.array(path).T[:2], color="gray", label="true path")
    axes.plot(*landmarks.T, "rx", label="true landmarks")
    axes.plot(*means.T, "k.", label="landmarks of the map")
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    figure.legend(loc="outside lower center", ncols=2)
    figure.savefig(sys.argv[1])
