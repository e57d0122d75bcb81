"""A robot's driver: passes the robot's measurements on to its team and loses none of them."""
