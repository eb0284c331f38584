"""What a scene copies to its device: triangles in the world frame, materials, textures.

Knows assets, but neither scene nor renderer.
"""
