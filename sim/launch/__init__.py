"""A team's processes: start, supervision, end."""
