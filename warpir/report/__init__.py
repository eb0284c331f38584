"""The report of a run, one page for a person: pictures, plots, facts and words.

Reads what a run has written; computes no picture of its own.
"""
