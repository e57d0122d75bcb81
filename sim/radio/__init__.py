"""A radio at each robot's door: what would not have reached it is dropped there."""
