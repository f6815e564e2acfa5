"""Cases at the edge, faults from outside and damaged files: `python -m tests.robustness` runs them."""
