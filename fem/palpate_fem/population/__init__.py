"""Several specimens on one simulated finger: their electrodes, fitted to published ranges."""
