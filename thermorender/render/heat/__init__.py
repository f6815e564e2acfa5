"""Temperatures of a terrain by heat balance: marched for its texels, and a learned map's moved to another instant."""
