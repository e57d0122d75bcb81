"""Certificates: the members of a team, and the credentials of each process."""
