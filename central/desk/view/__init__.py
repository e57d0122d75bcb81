"""Viewer: Foxglove views and a browser page."""
