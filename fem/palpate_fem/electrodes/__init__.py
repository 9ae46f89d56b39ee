"""Electrode physics: from the film between skin and core to the sensor's counts."""
