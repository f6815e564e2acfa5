"""Architectures of the networks, with their sources."""
