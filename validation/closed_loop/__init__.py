"""Closed loops: what vehicles miss that steer by rendered, translated and mapped frames."""
