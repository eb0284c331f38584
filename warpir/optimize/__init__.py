"""Optimisation of light and curves, or of materials: loop, unknowns, guidance, checkpoints.

The only room that drives the networks of `warpir.diffusion`; knows nothing of pages or commands.
"""
