"""The optimisation: loop, unknowns, guidance, checkpoints; light and curves, or the materials.

The only room that drives the networks of `warpir.diffusion`; knows nothing of pages or commands.
"""
