"""The HTML report of a comparison: tables, figures and pictures."""
