"""Diffuse light between surfaces: traced, solved, and baked to texels."""
