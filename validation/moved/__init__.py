"""Errors of learned maps moved to another hour and weather, compared with simpler methods."""
