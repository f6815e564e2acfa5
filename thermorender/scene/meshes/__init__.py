"""Files of meshes: glTF, OBJ and PLY, and the pieces that they are read into."""
