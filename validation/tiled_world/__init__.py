"""What ground of any size costs, and how well tiles stand for one piece."""
