"""Errors of a learned emissivity map on procedural scenes, beside simpler methods."""
