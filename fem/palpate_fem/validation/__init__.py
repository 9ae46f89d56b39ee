"""SimulatedIndentation beside measured forces, as the paper compares them."""
