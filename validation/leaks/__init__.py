"""Training pictures found in other pictures: planted leaks of six kinds, and pictures found by mistake."""
