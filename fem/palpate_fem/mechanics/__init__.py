"""Equilibrium of skin, fluid, core and indenter, and the load steps that follow a path."""
