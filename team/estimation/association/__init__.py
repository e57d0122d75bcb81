"""Which detections of a window are of one landmark, from the window's own measurements alone."""
