"""What is true of the simulated injector, for its IOC and for those who check its answers."""

# Emittance m, beta m, alpha at the entrance of the quadrupole, for x and y.
BEAM = {"x": (2.7e-9, 8.0, -1.1), "y": (2.2e-9, 7.0, -0.7)}
