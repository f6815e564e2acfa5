"""Learned maps: from a picture's colours, and what else is known, to apparent temperature or to materials."""

import os

# A thread of OpenMP that waits spins for a millisecond by default. Beside any other work on two cores it then keeps the
# processor from the thread that it waits for, and a network takes 25 times as long. So short a wait costs nothing on an
# idle machine. It is read when PyTorch or LightGBM are loaded.
os.environ.setdefault("GOMP_SPINCOUNT", "10000")
