"""What a world is, and a simulated one: arrays, no model of the filter."""
