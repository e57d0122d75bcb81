"""Convert ROS 2 messages to measurements, without ROS; the only folder that imports rosbags."""
