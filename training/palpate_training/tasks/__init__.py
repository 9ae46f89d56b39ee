"""What is learned: features, fields, synthesis, and the reports of their results."""
