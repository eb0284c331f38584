"""Where a light comes from: the user, a panorama, the photo; and the light that is optimised.

Knows no diffusion model.
"""
