"""A vehicle lands on a heated marker with an infrared camera; the renderer is in the loop."""
