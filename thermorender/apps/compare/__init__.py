"""Comparisons: learned translation with the render, learned maps with a data set, a frame with its cost."""

RANK = 30
VERBS = {"compare": "verbs:compare", "evaluate": "verbs:evaluate", "bench": "verbs:bench", "demo": "verbs:demo"}
