"""Placing an object by hand, in the browser: ``python -m warpir.place``.

Writes a configuration for `warpir.insert`; what estimates and renders runs in processes of its own.
"""
