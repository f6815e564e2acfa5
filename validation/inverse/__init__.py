"""Maps reconstructed from frames: against the truth of rendered frames, and against frames of a real flight."""
