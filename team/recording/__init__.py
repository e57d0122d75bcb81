"""MCAP logs: the only folder that imports `mcap`; it stores the wire's bytes unchanged."""
