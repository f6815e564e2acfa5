"""Damaged files for every reader: a corpus of small whole files, the damage, and what accepted inputs are used for."""
