"""Data association inside a window: decides which detections are of one landmark, from the
window's own measurements alone.
"""
