"""The team's set as every peer keeps it: what is in it, what to ask of whom, and its file."""
