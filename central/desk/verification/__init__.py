"""A log computed again, message by message, and compared with what was recorded."""
