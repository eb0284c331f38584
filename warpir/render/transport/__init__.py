"""Stored light transport: rows traced once, then every image is a matrix product.

Knows the renderer, but no optimisation.
"""
