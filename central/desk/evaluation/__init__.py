"""What a run was worth, from its log alone."""
