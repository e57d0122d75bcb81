"""The robot, and the parts that every process shares: estimation, wire, recording."""
