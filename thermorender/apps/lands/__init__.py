"""Scenes made here: procedural lands from a seed, and imports of elevation models, orthophotos and outlines."""

RANK = 10
VERBS = {"import-terrain": "verbs:import_terrain", "make-scene": "verbs:make_scene"}
