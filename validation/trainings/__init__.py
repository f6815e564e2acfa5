"""Trainings of networks beside each other: validation error against cost, and strips of epochs."""
