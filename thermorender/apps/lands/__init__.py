"""Scenes made here: procedural lands from a seed, and imports of elevation models, orthophotos and outlines."""

VERBS = {"make-scene": "verbs:make_scene", "import-terrain": "verbs:import_terrain"}
