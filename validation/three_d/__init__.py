"""What a draped orthophoto costs: frames of a survey from above against frames of the same world with walls."""
