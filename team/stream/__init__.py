"""Puts a robot's measurements in order and checks them, before they go to an estimator."""
