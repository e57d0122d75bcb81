"""A peer: a node that keeps the team's set and folds it by itself, as the centre does."""
