"""Simulated radio at each robot's bus."""
