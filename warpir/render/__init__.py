"""From scene and light to radiance, shadow ratio and composite, with gradients.

The only room that imports Warp; knows nothing of where a light comes from or what judges a picture.
"""
