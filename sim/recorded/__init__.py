"""A recorded run as a world again: its streams, a data set of them, a run with changes."""
