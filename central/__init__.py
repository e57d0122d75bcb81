"""The central computer: the node that stores and folds the set of submaps, and its process."""
