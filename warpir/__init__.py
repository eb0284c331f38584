"""warpir: put a 3D object into a photograph so that it looks as if it had stood there."""

__version__ = "0.1.0"
