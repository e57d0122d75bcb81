"""Fusion rules of the sources, for comparison; the product runs without them."""
