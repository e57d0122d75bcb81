"""World process: publishes measurements as far as credit allows."""
