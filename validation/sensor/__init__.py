"""Errors of lag and blur against run time, and the cost of the whole chain."""
