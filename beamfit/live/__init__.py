"""Running machines: scans that restore their magnets, and watches of a beam lifetime."""
