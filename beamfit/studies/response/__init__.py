"""Responses of a process to its inputs, identified from records of runs."""
