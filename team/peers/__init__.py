"""The team's set of members at each peer: contents, exchange between peers, and file."""
