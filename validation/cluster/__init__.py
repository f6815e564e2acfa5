"""What a flight costs on a cluster: measured on this machine, and simulated for many workers."""
