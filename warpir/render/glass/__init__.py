"""Solid glass on the device: what it absorbs, how the shadow takes it, and its rows of transport.

The kernels are `warpir.kernels.dielectric`.
"""
