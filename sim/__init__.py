"""Worlds and data sets, and above them launch, replay, evaluation and the command line."""
