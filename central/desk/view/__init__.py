"""The viewer: a team's messages as Foxglove's views, and as a page in a browser."""
