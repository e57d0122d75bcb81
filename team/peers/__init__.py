"""The team's set of members at each peer: contents, exchange and file."""
