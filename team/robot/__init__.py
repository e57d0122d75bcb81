"""The member of the team: its node (no I/O), its configuration and its shell."""
