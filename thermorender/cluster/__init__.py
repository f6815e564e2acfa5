"""Campaigns on several machines, by Dask: where the workers are, what they are sent, and what comes back."""
