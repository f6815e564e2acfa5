"""Error against run time, beside stock Mitsuba, against a path-traced reference."""
