"""The camera of a photograph from fSpy, COLMAP, nerfstudio, Waymo, glTF or OpenEXR files.

Knows how each tool turns its axes, and nothing of what is rendered.
"""
