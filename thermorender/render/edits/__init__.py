"""Edits of materials and temperatures of a baked scene: previews, and solutions that begin from the known light."""
