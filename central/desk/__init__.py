"""The operator's desk: what a person looks at of a running or recorded team."""
