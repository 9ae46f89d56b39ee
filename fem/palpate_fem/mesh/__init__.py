"""Solid meshes of the skin: nodes, elements, named surfaces, and where they come from."""
