"""A robot of the team: its node (no I/O), the node's parts, and its process."""
