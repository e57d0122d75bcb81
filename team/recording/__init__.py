"""MCAP logs of the wire's unchanged bytes; the only folder that imports `mcap`."""
