"""Bridges: the frames of a server in the words of other programs. Each is off unless it is asked for."""
