"""Comparison of learned 2D translation with the render, of maps with a data set, and of frames with their cost."""
