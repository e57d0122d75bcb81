"""Import foreign logs as data sets in folders of CSV tables."""
