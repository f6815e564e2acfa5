"""A vehicle that lands on a heated marker by what its infrared camera sees, the renderer in the loop."""
