"""Path tracing anew at every step: samples of light and BSDF, and their gradients.

Knows the renderer, but no optimisation.
"""
