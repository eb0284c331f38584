"""Stable Diffusion as a prior, its folder, and files of weights.

Knows no guidance and no optimisation.
"""
