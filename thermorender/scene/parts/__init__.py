"""The parts of a scene as its files hold them: terrain, meshes, objects, tracks and the materials that cover them."""
