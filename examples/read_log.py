"""List the log of a run, and join the team's map again from its submaps.

python examples/read_log.py runs/FOLDER/log.mcap
"""

import sys

import numpy as np

from teamslam import join, open_log, submaps_in

log = open_log(sys.argv[1])
print(f"team {log.team}, {'complete' if log.complete else 'its recorder was killed'}")
for key, (messages, size) in sorted(log.counts().items()):
    print(f"{messages:7d} messages {size:9d} B  {key}")

submaps = submaps_in(log)
for robot, of_robot in submaps.items():
    travelled = sum(np.linalg.norm(each.end_pose[:2]) for each in of_robot)
    print(f"{robot}: {len(of_robot)} submaps, {travelled:.1f} m from window to window")
team = join(submaps, {})  # in the frame of the first robot's start
print(f"joined: {len(team.landmarks.ids)} landmarks, cost per dof {team.chi2 / team.dof:.2f}")
for robot, why in team.apart.items():
    print(f"{robot} is apart: {why}")
