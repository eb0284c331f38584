"""The camera of one photo: pitch, roll, field of view and principal point, with uncertainties.

Knows photos and cameras; nothing of objects, light or rendering.
"""
