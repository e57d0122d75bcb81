"""Viewer: a team's messages as Foxglove views and as a browser page."""
