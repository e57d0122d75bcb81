"""Drive a robot: python robot.py r1 data/r1 lab tcp/127.0.0.1:7447 [SECONDS A STEP]."""

import csv
import sys
import time
from decimal import Decimal
from itertools import groupby
from pathlib import Path

import numpy as np

from teamslam import Driver

name, folder, team, endpoint, *pause = sys.argv[1:]
events, speed = [], [0.0, 0.0]
for kind in ("observations", "odometry"):
    rows = list(csv.reader((Path(folder) / f"{kind}.csv").open()))[1:]
    for t, group in groupby(rows, lambda row: row[0]):
        events.append((Decimal(t), kind, [float(x) for row in group for x in row[1:] if x]))
given = Path(folder) / "start.csv"  # without this file the landmarks place the robot
start = [float(x) for x in given.read_text().split()[1].split(",")] if given.exists() else None

with Driver(name, team=team, connect=endpoint, start=start) as robot:
    for t, kind, numbers in sorted(events):  # landmarks at t precede the odometry until t
        if kind == "odometry":
            robot.odometry(t, *speed)  # until t, since the last call
            speed = numbers
            time.sleep(float(pause[0]) if pause else 0.0)
        else:
            robot.observe(t, *np.reshape(numbers, (-1, 3)).T)
