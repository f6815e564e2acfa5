"""Procedural scenes: noise, painting, light, weather, and one layout per kind of landscape."""
