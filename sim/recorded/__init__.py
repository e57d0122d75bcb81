"""A log computed again: as it was, or under other conditions."""
