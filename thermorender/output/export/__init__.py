"""Frames of a folder in the forms of other programs: labels for machine learning, photographs of a survey, maps."""
