"""How the table of standard atmospheres was fitted: terms fitted to paths of LOWTRAN7, and lines of sight held out."""
