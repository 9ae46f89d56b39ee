"""Electrode physics: from the skin's position, through the fluid film, to the sensor's counts."""
