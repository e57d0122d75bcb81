"""Models' figures learnt from readings."""
