"""Output: frames as files, videos, flights and days."""
