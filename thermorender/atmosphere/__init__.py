"""Air between camera and ground: standard atmospheres, soundings, MODTRAN files; rays, absorbers and emission."""
