"""What a picture is put together from: the scene of a run, its planes, a preview of its light.

Knows the renderer, but no compositing.
"""
