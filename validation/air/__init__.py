"""What air costs a frame, and the error of its spectral channels."""
