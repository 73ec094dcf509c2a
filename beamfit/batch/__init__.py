"""A year's files in, one row an answer out."""
