"""A whole team in one process, with simulated links."""
