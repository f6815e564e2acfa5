"""Solids with walls and crowns as textured surfaces of a mesh, and the files of such a mesh."""
