"""Programs that behave like the devices, faults included; written from the protocol page."""
