"""What real cameras' files tell: readers, statistics and calibration."""
