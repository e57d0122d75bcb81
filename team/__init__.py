"""What every robot carries (estimation, wire, recording) and the robot itself."""
