"""Data sets for learned maps, gathered from scenes."""
