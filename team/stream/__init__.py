"""A robot's measurements on their way to an estimator: in their order, cut into keyframes."""
