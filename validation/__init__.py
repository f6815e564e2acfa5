"""Studies that validate the shipped code, with their results: `python -m validation` makes the page of verdicts."""
