"""Definitions of the ROS 2 message types that are read: a distribution's, and detectors'."""

from functools import cache

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

_HEADER = "std_msgs/Header header\n"
DETECTORS = {
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score",
    "vision_msgs/msg/ObjectHypothesisWithPose": (
        "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose"
    ),
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size",
    "vision_msgs/msg/Detection3D": (
        _HEADER + "vision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox3D bbox\nstring id"
    ),
    "vision_msgs/msg/Detection3DArray": _HEADER + "vision_msgs/Detection3D[] detections",
    "isaac_ros_apriltag_interfaces/msg/AprilTagDetection": (
        "string family\nint32 id\ngeometry_msgs/Point center\ngeometry_msgs/Point[4] corners\n"
        "geometry_msgs/PoseWithCovarianceStamped pose"
    ),
    "isaac_ros_apriltag_interfaces/msg/AprilTagDetectionArray": (
        _HEADER + "isaac_ros_apriltag_interfaces/AprilTagDetection[] detections"
    ),
    "aruco_opencv_msgs/msg/MarkerPose": "uint16 marker_id\ngeometry_msgs/Pose pose",
    "aruco_opencv_msgs/msg/BoardPose": "string board_name\ngeometry_msgs/Pose pose",
    "aruco_opencv_msgs/msg/ArucoDetection": (
        _HEADER + "aruco_opencv_msgs/MarkerPose[] markers\naruco_opencv_msgs/BoardPose[] boards"
    ),
    "ros2_aruco_interfaces/msg/ArucoMarkers": (
        _HEADER + "int64[] marker_ids\ngeometry_msgs/Pose[] poses"
    ),
    "aruco_msgs/msg/Marker": (
        _HEADER + "uint32 id\ngeometry_msgs/PoseWithCovariance pose\nfloat64 confidence"
    ),
    "aruco_msgs/msg/MarkerArray": _HEADER + "aruco_msgs/Marker[] markers",
}
"""Fields of detectors' messages, which no distribution contains."""


@cache
def types() -> Typestore:
    """Return all types; a bag's own definitions have precedence."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    found = {}
    for name, text in DETECTORS.items():
        found.update(get_types_from_msg(text, name))
    store.register(found)
    return store
