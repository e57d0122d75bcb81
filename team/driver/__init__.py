"""A robot's driver: what it measures goes onto the team, and nothing of it is lost on the way."""
