"""From a record of beam current to lifetimes and loss mechanisms."""
