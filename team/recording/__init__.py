"""MCAP: the only folder that imports `mcap`; it stores wire bytes as they came."""
