"""Studies: emittance, lifetime, dynamics."""
