"""Read the next submap of a running team from Zenoh.

python examples/read_submap.py tcp/127.0.0.1:7447 waypoints
"""

import sys

import numpy as np
import zenoh

from teamslam import submap_in

endpoint, team = sys.argv[1:3]
links = f'mode: "client", connect: {{endpoints: ["{endpoint}"]}}'
config = zenoh.Config.from_json5(f"{{{links}, scouting: {{multicast: {{enabled: false}}}}}}")
key = f"team/{team}/robot/*/submap"
history = zenoh.ext.HistoryConfig(detect_late_publishers=True)  # with submaps published earlier
with zenoh.open(config) as session:
    subscriber = zenoh.ext.declare_advanced_subscriber(session, key, history=history)
    robot, sequence, submap = submap_in(subscriber.recv().payload.to_bytes())

sigma = np.sqrt(np.diag(submap.covariance))
print(f"submap {sequence} of {robot}, in the frame of its start pose")
print(f"end pose {submap.end_pose.round(3)}, sigma {sigma[:3].round(3)}")
for number, mean in zip(submap.ids, submap.landmarks, strict=True):
    print(f"landmark {number} at {mean.round(2)} m")
