"""How the table of atmospheres was fitted: LOWTRAN7, the terms fitted to its paths, the lines of sight kept out."""
