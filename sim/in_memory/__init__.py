"""A whole team in one process, and what its messages meet on their way."""
