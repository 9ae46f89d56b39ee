"""Everything that is published on the bus, written to MCAP records."""
