"""A robot's driver: delivers its measurements to the team and loses none."""
