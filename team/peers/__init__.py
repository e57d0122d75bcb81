"""The team's set of members at each peer: its contents, the exchange between peers, and its file."""
