"""Small and far targets against a long lens: `python -m validation.targets`."""
