"""The report of a comparison: an HTML page with tables, figures and pictures, and tables for the terminal."""
