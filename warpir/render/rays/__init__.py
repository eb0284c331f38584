"""What finds hits on the CPU in place of Warp's own tree.

Knows triangles, but no scene.
"""
