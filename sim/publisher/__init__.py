"""The world's process: publishes readings as far as credit allows."""
