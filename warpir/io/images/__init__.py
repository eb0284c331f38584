"""Photographs, masks, panoramas and their colours: decoded, checked, upright and linear.

Knows nothing of meshes or cameras files; decoding is OpenImageIO's.
"""
