"""Map joining, the back end: submaps become one map by least squares."""
