"""The condition of a sensor, judged from its frames: still, untouched, warm, intact."""
