"""What every task learns with: splits, networks, the training loop, metrics, baselines, export."""
