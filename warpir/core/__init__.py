"""What every room stands on: errors, limits, colour, strict JSON, files, caches, memory.

Knows nothing of scenes, photographs or networks; imports no other room.
"""
