"""Time and memory of translating a picture with each learned map, and the steps at its tiles' borders."""
