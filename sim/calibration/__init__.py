"""Model calibration from measurements."""
