"""The team's set of members as every peer keeps it: what it holds, what peers request, and its
file.
"""
