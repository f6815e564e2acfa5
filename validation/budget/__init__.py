"""The stated sampling error of frames against 256 rays per pixel."""
