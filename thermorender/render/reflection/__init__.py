"""Reflection by materials whose emissivity depends on the angle of view: tables by angle, and mirror images."""
