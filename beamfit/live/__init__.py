"""A machine that runs: scans that restore what they moved, and a beam's lifetime watched."""
