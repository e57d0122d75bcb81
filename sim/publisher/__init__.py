"""The world's process: publishes measurements as far as credit allows."""
