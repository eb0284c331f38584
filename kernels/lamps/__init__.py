"""Lamps near the object: spheres and rectangles that shine and are not seen."""
