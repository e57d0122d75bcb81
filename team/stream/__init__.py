"""A robot's readings on their way to an estimator: in their order, cut into epochs."""
