"""Comparison of trainings of networks: validation error against cost, and strips of epochs."""
