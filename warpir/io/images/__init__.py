"""Photographs, masks, panoramas and their colours: decoded, checked, upright and linear.

Knows nothing of meshes or camera files; decoding is OpenImageIO's.
"""
