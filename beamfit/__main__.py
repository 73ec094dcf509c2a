"""`python -m beamfit` is the command `beamfit`."""

from beamfit.cli import main

if __name__ == "__main__":
    main()
