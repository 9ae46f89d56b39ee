"""Recordings and simulations -> data sets -> networks -> bundles; the only room with torch."""

EXTRA_MODULES = ("torch", "onnx", "h5py", "matplotlib")
"""What ``palpate[training]`` installs and a bare palpate has not."""
