"""What a map was trained on: fingerprints of its training pictures, and their search in others."""
