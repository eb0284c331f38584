"""What is in the picture, as plain NumPy records: asset, camera, light, ground, placement.

Knows no files, no Warp and no torch.
"""
