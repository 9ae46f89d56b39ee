"""Electrodes to displacement fields of the skin, and back: small networks on the mixed data set."""
