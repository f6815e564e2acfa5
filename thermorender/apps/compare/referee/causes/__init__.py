"""Causes of a method's error: the fit of each pose, and what explains more than its rivals."""
