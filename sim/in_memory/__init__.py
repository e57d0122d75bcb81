"""A whole team in one process, and simulated links for its messages."""
