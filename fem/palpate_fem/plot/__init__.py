"""Pictures of simulations, calibrations and validations."""
