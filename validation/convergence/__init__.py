"""Error against run time of this renderer and of stock Mitsuba, with a path-traced reference."""
