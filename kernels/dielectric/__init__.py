"""Solid glass: an interface that reflects and refracts, and what light loses behind it."""
