"""Recordings as devices: palpate records and text logs of the vendor."""
