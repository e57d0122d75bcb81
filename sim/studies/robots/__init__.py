"""Robots with the sources' estimators, for comparison; the product runs without them."""
