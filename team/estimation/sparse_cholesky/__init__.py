"""A sparse Cholesky factorisation with its solves and the entries of the inverse."""
