"""Model bundles to estimates on the bus; everything that was said to records and pictures."""
