"""Generators of what the package ships; outside the wheel."""
