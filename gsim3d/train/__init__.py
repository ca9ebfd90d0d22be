"""Training: configuration, losses, loop, checkpoints."""
