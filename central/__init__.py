"""The central computer: fusion rules, the node that keeps the set of submaps, and its shell."""
