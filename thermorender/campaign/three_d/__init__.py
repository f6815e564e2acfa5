"""Procedural scenes in three dimensions, beside what a survey from above sees of them."""
