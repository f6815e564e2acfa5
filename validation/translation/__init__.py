"""Seconds and memory of translating a picture with each learned map, and the steps where its tiles meet."""
