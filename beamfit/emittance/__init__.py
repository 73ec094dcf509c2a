"""Beams from sizes: scans, their fit, and what to measure next."""
