"""From a measurement to a fit: scans, the emittance fit, its verdict and its sensitivities."""
