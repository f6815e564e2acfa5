"""Errors of learned maps and of simpler methods on a data set, in kelvin."""
