"""What is written: frames as files, videos, and flights."""
