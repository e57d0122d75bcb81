"""Write the CSV tables of two robots that drive bends: python own_data.py my_set."""

import csv
import sys
from math import atan2, cos, hypot, pi, remainder, sin
from pathlib import Path
from random import Random

LANDMARKS = {7: (2.0, 1.0), 12: (-3.0, 2.0), 13: (1.0, -4.0), 20: (5.0, 3.0), 31: (-2.0, -5.0)}
STEP_S, STEPS = 0.1, 2400


def write(file, columns, rows):
    """Write one table."""
    with file.open("w", newline="") as out:
        csv.writer(out).writerows([columns, *rows])


folder, noise = Path(sys.argv[1]), Random(1)  # noqa: S311 - noise of a sensor, no secret
for robot, (x, y, theta) in {"r1": (4.0, 0.0, pi / 2), "r2": (-4.0, 0.0, -pi / 2)}.items():
    odometry, seen, truth = [], [], []
    start = (x, y, theta)
    for k in range(STEPS):
        t = round(k * STEP_S, 3)
        speed, yaw_rate = 0.5 + 0.3 * sin(t / 7), 0.12 + 0.1 * sin(t / 17)
        odometry.append((t, speed + noise.gauss(0, 0.02), yaw_rate + noise.gauss(0, 0.01)))
        truth.append((t, x, y, theta))
        if k % 5 == 0:
            for number, (at_x, at_y) in LANDMARKS.items():
                distance = hypot(at_x - x, at_y - y) + noise.gauss(0, 0.05)
                bearing = atan2(at_y - y, at_x - x) - theta + noise.gauss(0, 0.02)
                seen.append((t, number, distance, remainder(bearing, 2 * pi)))
        theta += yaw_rate * STEP_S
        x, y = x + speed * STEP_S * cos(theta), y + speed * STEP_S * sin(theta)
    place = folder / robot
    place.mkdir(parents=True)
    write(place / "odometry.csv", ("t_s", "forward_m_s", "yaw_rate_rad_s"), odometry)
    write(place / "observations.csv", ("t_s", "landmark", "range_m", "bearing_rad"), seen)
    write(place / "truth.csv", ("t_s", "x_m", "y_m", "theta_rad"), truth)
    write(place / "start.csv", ("x_m", "y_m", "theta_rad"), [start])
write(folder / "landmarks.csv", ("landmark", "x_m", "y_m"), [(i, *p) for i, p in LANDMARKS.items()])
