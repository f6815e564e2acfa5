"""Emissivity from colour and texture: which materials each texel of an orthophoto may be."""
