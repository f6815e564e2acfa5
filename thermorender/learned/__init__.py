"""Learned maps: from a picture and optional extra inputs to apparent temperature or materials."""

import os

# Waiting OpenMP threads spin for a millisecond by default. With other work on two cores, a network then takes 25 times
# as long. This shorter spin costs nothing on an idle machine. PyTorch and LightGBM read it when they are loaded.
os.environ.setdefault("GOMP_SPINCOUNT", "10000")
