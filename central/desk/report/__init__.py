"""A run in tables and on a page."""
