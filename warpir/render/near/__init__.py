"""Lamps near the object as rows: what each of them gives at power 1, beside the light from afar.

Knows the renderer, but no optimisation.
"""
