"""The networks themselves: layers and how they are joined, with their sources."""
