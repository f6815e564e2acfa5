"""Weather as a time series: measured, of a typical year, or of a named day."""
