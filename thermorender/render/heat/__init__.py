"""Temperatures of a terrain by its heat balance: simulated for its texels, or a learned map's moved to another instant."""
