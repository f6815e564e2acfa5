"""The heat balance and simpler methods against measured surface temperatures."""
