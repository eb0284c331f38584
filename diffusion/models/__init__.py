"""The priors as networks: Stable Diffusion, the embedded prior, and their folders and weights.

Knows no guidance and no optimisation.
"""
