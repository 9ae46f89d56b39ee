"""Direct solution of the tangent's linear systems: ordering, fronts, and SuperLU beside them."""
