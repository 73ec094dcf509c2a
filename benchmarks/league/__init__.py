"""beamfit beside every peer on the same work: honesty and speed. `python -m benchmarks.league`."""
