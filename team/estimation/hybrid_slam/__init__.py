"""Hybrid-SLAM, the front end: measurements become independent submaps."""
