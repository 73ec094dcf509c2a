"""Noise of measurements: stated priors, averaged over."""
