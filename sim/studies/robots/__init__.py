"""Estimators of the sources as a robot runs them, for comparison; the product runs without them."""
