"""Learned maps on real pairs of pictures, each group of pictures tested by maps trained on the others."""
