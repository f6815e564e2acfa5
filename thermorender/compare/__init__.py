"""Comparisons: learned 2D translation with the render, learned maps with a data set, and frames with their cost."""
