"""What a scene declares, what follows from it, and how it is fingerprinted and printed."""
