"""Evaluation of light and insertions on scenes whose light is known.

Uses the other packages through their public functions; a run does not need it.
"""
