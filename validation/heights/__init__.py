"""Error against run time by height, and the cost of a frame beside other ray casters on the same mesh."""
