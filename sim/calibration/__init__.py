"""Models' figures learnt from measurements."""
