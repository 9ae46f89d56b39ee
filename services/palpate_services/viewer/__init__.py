"""Pictures of records and simulations: Rerun views and plots."""
