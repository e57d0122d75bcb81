"""A recorded run as a world: its streams, a data set of them, a run with changes."""
