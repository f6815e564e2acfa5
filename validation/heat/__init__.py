"""The heat balance against measured surface temperatures, beside simpler methods."""
