"""Certificates: who is in a team, and the proof of it that each process carries."""
