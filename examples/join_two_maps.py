"""Join the submaps of two robots that map one hall by Hybrid-SLAM.

Only the initial pose of the first robot is known; common landmarks place the second one.

    python examples/join_two_maps.py [PICTURE]
"""

import sys

import numpy as np

from teamslam import (
    InitialPose,
    Keyframe,
    LocalMap,
    MotionModel,
    MotionNoise,
    Sensor,
    batch_map,
    compose,
    increment_of,
    join,
    measurement_of,
    submap_of,
)  # fmt: skip

WINDOW = 10
SENSOR = Sensor(range_sigma=0.1, bearing_sigma=0.02)
MOTION = MotionModel(forward=MotionNoise(per_m=0.05), turn=MotionNoise(per_rad=0.05))
rng = np.random.default_rng(2)
landmarks = rng.uniform(0.0, 24.0, (24, 2))


def drive(pose: np.ndarray, yaw_rate: float, keyframes: int) -> tuple[np.ndarray, list[Keyframe]]:
    """Return the true path (keyframes, 3) from `pose`, and the keyframes measured on it."""
    path, measured = [], []
    for _ in range(keyframes):
        increment = increment_of(MOTION, duration_s=1.0, forward=0.8, yaw_rate=yaw_rate)
        sigma = (0.05 * np.sqrt(0.8), 0.0, 0.05 * np.sqrt(abs(yaw_rate)))
        pose = compose(pose, increment.mean + rng.normal(0.0, sigma))
        z = np.array([measurement_of(pose, landmark) for landmark in landmarks])
        z += rng.normal(0.0, (0.1, 0.02), z.shape)
        seen = np.flatnonzero(z[:, 0] < 7.0)
        path.append(pose)
        measured.append(
            Keyframe(
                increment=increment,
                ids=seen.astype(np.uint32),
                ranges=z[seen, 0],
                bearings=z[seen, 1],
            )
        )
    return np.array(path), measured


def submaps(keyframes: list[Keyframe]) -> list[LocalMap]:
    """Make an independent submap of every ten keyframes."""
    windows = [keyframes[k : k + WINDOW] for k in range(0, len(keyframes), WINDOW)]
    return [submap_of(window, SENSOR, rng) for window in windows]


starts = {"r1": np.array([4.0, 8.0, -0.6]), "r2": np.array([20.0, 8.0, 2.2])}
driven = {
    "r1": drive(starts["r1"], yaw_rate=0.10, keyframes=70),
    "r2": drive(starts["r2"], yaw_rate=0.11, keyframes=70),
}
team = join(
    {robot: submaps(keyframes) for robot, (_, keyframes) in driven.items()},
    {"r1": InitialPose(pose=starts["r1"])},
)
reference = batch_map(
    {robot: keyframes for robot, (_, keyframes) in driven.items()},
    dict.fromkeys(driven, SENSOR),
    {  # initial value of the batch, near the true start, with a wide prior
        "r1": InitialPose(pose=starts["r1"]),
        "r2": InitialPose(pose=starts["r2"], covariance=np.diag((100.0, 100.0, 10.0))),
    },
)


def rmse(ids: np.ndarray, means: np.ndarray) -> float:
    """Return the root mean square error of landmarks [m]."""
    return float(np.sqrt(np.mean(np.sum((means - landmarks[ids]) ** 2, axis=1))))


print(f"joined: {len(team.landmarks.ids)} landmarks of {', '.join(team.trajectories)}")
print(f"landmark RMSE {rmse(team.landmarks.ids, team.landmarks.means):.3f} m, ", end="")
print(f"of the batch reference {rmse(reference.landmarks.ids, reference.landmarks.means):.3f} m")
print(f"joint cost per dof {team.chi2 / team.dof:.2f}; not joined: {team.apart or 'none'}")

if len(sys.argv) > 1:
    from matplotlib.figure import Figure
    from matplotlib.patches import Ellipse

    figure = Figure(figsize=(7, 8), layout="constrained")
    axes = figure.subplots()
    for colour, (robot, (path, _)) in zip(("C0", "C1"), driven.items(), strict=True):
        axes.plot(*path.T[:2], color=colour, alpha=0.4, label=f"{robot}, true path")
        ends = team.trajectories[robot].poses
        axes.plot(*ends.T[:2], "o", color=colour, label=f"{robot}, ends of submaps")
    axes.plot(*landmarks.T, "rx", label="true landmarks")
    for k, mean in enumerate(team.landmarks.means):
        block = team.landmarks.covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2]
        values, vectors = np.linalg.eigh(block)
        width, height = 2.0 * np.sqrt(5.991 * values)  # 95 % of a Gaussian with two numbers
        angle = np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0]))
        axes.add_patch(Ellipse(mean, width, height, angle=angle, fill=False))
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    figure.legend(loc="outside lower center", ncols=3)
    figure.savefig(sys.argv[1])
