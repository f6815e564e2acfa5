"""The stated total error of frames where bodies stand on each other, against path tracing and closed forms."""
