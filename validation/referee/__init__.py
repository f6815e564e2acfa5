"""What the referee names: planted faults and innocent frames on unseen lands."""
