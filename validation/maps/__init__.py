"""Errors of learned temperature maps against their training data: amount, alignment, kinds of land."""
