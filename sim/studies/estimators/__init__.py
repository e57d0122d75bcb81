"""Estimators of the sources, for comparison; the product does not use them."""
