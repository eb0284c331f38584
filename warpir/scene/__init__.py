"""Scene description as plain NumPy records: asset, camera, light, ground, placement.

Knows no files, no Warp and no torch.
"""
