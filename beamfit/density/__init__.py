"""The density of a beam in phase space from the profiles of a quadrupole scan, with its error."""
