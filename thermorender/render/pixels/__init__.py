"""The rays of a pixel: its footprint, how finely it is sampled, and the budget of its error."""
