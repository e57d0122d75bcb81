"""Zenoh sessions, router and bus, and the recovery of lost samples."""
