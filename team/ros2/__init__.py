"""Messages of ROS 2 as measurements, with no ROS on our side; the one folder that has rosbags."""
