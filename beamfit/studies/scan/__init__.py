"""From a scan of sizes to an emittance, and what to set or measure next."""
