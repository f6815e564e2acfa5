"""Time and memory against triangles, texels and spectral nodes."""
