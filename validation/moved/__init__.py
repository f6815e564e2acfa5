"""Errors of maps moved to another hour and weather, beside simpler methods."""
