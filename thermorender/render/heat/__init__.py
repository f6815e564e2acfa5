"""Temperatures of a terrain by its heat balance: simulated per texel, or a learned map's moved to another instant."""
