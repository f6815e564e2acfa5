"""Work spread over several processes or machines by Dask: where the workers are, and what they are sent."""

PROVIDES = {"workers": "workers"}
