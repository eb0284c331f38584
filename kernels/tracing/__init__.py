"""Rays against the object's mesh, its textures, and surfaces at hits."""
