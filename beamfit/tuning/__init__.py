"""Tuning: the knob setting with the lowest emittance, from beam sizes, and the next row."""
