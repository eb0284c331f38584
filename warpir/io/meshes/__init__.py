"""OBJ, PLY and STL meshes, point clouds, and the files that an asset brings along.

Knows no glTF.
"""
