"""The shadow ratio of a whole picture: where it changes, where it is smooth, what is traced.

Knows the renderer, but no compositing.
"""
