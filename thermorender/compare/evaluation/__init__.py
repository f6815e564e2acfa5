"""Errors of learned maps on a data set, in kelvin, beside simpler methods."""
