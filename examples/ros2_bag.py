"""Write a small ROS 2 bag of a robot with a camera: python ros2_bag.py my_bag."""

import sys
from math import cos, sin

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

TAGS = {7: (2.0, 1.0), 12: (6.0, -1.0), 13: (9.0, 1.5)}
STORE = get_typestore(Stores.ROS2_HUMBLE)
T = STORE.types


def header(t_ns, frame):
    """Return the header with time and frame."""
    time = T["builtin_interfaces/msg/Time"](sec=t_ns // 10**9, nanosec=t_ns % 10**9)
    return T["std_msgs/msg/Header"](stamp=time, frame_id=frame)


def transform(t_ns, parent, child, x, y, z, q=(0.0, 0.0, 0.0, 1.0)):
    """Return the pose of `child` in `parent`."""
    return T["geometry_msgs/msg/TransformStamped"](
        header=header(t_ns, parent),
        child_frame_id=child,
        transform=T["geometry_msgs/msg/Transform"](
            translation=T["geometry_msgs/msg/Vector3"](x=x, y=y, z=z),
            rotation=T["geometry_msgs/msg/Quaternion"](x=q[0], y=q[1], z=q[2], w=q[3]),
        ),
    )


def odometry(t_ns, x, y, theta):
    """Return accumulated wheel odometry."""
    vector, zeros = T["geometry_msgs/msg/Vector3"], np.zeros(36)
    twist = T["geometry_msgs/msg/Twist"](
        linear=vector(x=0.5, y=0.0, z=0.0), angular=vector(x=0.0, y=0.0, z=0.0)
    )
    pose = T["geometry_msgs/msg/Pose"](
        position=T["geometry_msgs/msg/Point"](x=x, y=y, z=0.0),
        orientation=T["geometry_msgs/msg/Quaternion"](
            x=0.0, y=0.0, z=sin(theta / 2), w=cos(theta / 2)
        ),
    )
    return T["nav_msgs/msg/Odometry"](
        header=header(t_ns, "odom"),
        child_frame_id="base_link",
        pose=T["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=zeros),
        twist=T["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=zeros),
    )


with Writer(sys.argv[1], version=9, storage_plugin=StoragePlugin.MCAP) as bag:
    odom = bag.add_connection("/odom", "nav_msgs/msg/Odometry", typestore=STORE)
    tf = bag.add_connection("/tf", "tf2_msgs/msg/TFMessage", typestore=STORE)
    static = bag.add_connection("/tf_static", "tf2_msgs/msg/TFMessage", typestore=STORE)

    def send(connection, t_ns, message):
        """Write a message to the bag."""
        bag.write(connection, t_ns, STORE.serialize_cdr(message, connection.msgtype))

    optical = transform(0, "base_link", "camera_optical", 0.2, 0.0, 0.4, (-0.5, 0.5, -0.5, 0.5))
    send(static, 0, T["tf2_msgs/msg/TFMessage"](transforms=[optical]))
    for k in range(300):  # 30 s at 0.3 m/s, past the tags
        t_ns, x = (k + 1) * 10**8, 0.03 * k
        send(odom, t_ns, odometry(t_ns, x, 0.0, 0.0))
        tags = [
            transform(t_ns, "camera_optical", f"tag36h11:{i}", -ty, 0.0, tx - x - 0.2)
            for i, (tx, ty) in TAGS.items()
            if 0.5 < tx - x < 6.0
        ]
        if tags and k % 3 == 0:
            send(tf, t_ns, T["tf2_msgs/msg/TFMessage"](transforms=tags))
