"""Training of networks: the loop, its checkpoints, logs and sample pictures."""
