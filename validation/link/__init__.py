"""What the link costs: latency and frames per second beside the bare render."""
