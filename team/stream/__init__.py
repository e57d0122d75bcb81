"""Order and check a robot's measurements before estimation."""
