"""Studies that prove the shipped code, each beside its results: `python -m validation` makes the page of verdicts."""
