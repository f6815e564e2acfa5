"""Where tables of the atmosphere come from: LOWTRAN, the fit of its lines of sight, own soundings, MODTRAN files."""
