"""From radiance to counts to a display image: camera, optics, pixels, noise, read-out, gain control."""
