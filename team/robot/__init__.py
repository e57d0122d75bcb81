"""A robot of the team: its node (no I/O), the parts of the node, and its process."""
