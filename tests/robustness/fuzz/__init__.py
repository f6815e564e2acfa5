"""Damaged files for every reader: a corpus of small undamaged files, the damage, and uses of accepted inputs."""
