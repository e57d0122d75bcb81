"""Bounds by which a jump of odometry poses is a reset, not a motion."""

RESET_M, RESET_TIMES, USUAL_M_S, LEAST_STEPS = 0.5, 20.0, 0.25, 10
"""A reset of odometry poses: least length [m], speed beside the usual one, which is taken to be as
large at least [m/s], and the least number of steps of which the usual one is known."""
