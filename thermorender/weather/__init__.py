"""Weather as a series in time: measured, of a typical year, or of a named day."""
