"""Hybrid-SLAM, the front end: turns measurements into independent submaps."""
