"""Errors of learned temperature maps against what they were trained on: how much, how aligned, which land."""
