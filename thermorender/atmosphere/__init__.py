"""Air between camera and ground: standard atmospheres, own soundings, MODTRAN files; rays, absorbers and emission."""
