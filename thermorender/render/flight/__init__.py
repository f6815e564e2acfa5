"""The frames of a flight: the renderer of each instant, and the sensor with its state from frame to frame."""
