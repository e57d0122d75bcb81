"""A simulated radio at each robot's bus, which drops messages from out of reach."""
