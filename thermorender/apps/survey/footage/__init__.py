"""Files of real cameras: readers, statistics and calibration."""
