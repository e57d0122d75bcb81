"""Experiments and the batch reference, without which the product runs."""
