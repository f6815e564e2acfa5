"""Errors of a learned emissivity map and of simpler methods on procedural scenes."""
