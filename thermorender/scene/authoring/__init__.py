"""Materials of a scene's files: read as a value, edited, and written back with a difference in words."""
