"""Every byte that comes in or goes out: images, assets, cameras, lights, and the folder of results.

Knows the records of `warpir.scene`, but neither the configuration nor a renderer.
"""
