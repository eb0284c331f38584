"""What stands near the object beside the ground: lamps.

Compact sources at infinity, such as the sun, are `warpir.scene.lamps`.
"""
