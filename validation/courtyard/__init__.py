"""Long-wave radiation from the walls of a courtyard by orientation and hour, against measurements."""
