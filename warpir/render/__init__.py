"""From scene and light to radiance, shadow ratio and composite, with gradients.

Imports Warp, as only `warpir.train` does beside it; knows nothing of where a light comes from or of
what judges a picture.
"""
