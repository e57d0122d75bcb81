"""Estimators of the sources, for comparison; nothing that maps in earnest needs this folder."""
