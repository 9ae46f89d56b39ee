"""How a sensor does, told from its frames: whether it is touched, settled, warm and intact."""
