"""What other programs read: logs as data sets, paths as files."""
