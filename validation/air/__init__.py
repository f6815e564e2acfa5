"""Cost of air in a frame, and the error of its spectral channels."""
