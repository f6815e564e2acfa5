"""What far ground is worth: frames toward the horizon against those of a world in full."""
