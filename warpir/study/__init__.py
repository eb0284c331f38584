"""A study with people, which of two composites looks right: ``python -m warpir.study``.

Knows images and answers, and nothing of how a composite was made.
"""
