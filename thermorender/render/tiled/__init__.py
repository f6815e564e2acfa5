"""Frames over a ground of any size: squares of tiles are baked once, kept on disk, and put together for a camera."""
