"""The air of the weather against whole soundings: `python -m validation.soundings`."""
