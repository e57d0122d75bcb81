"""Certificates and credentials of a team's processes."""
