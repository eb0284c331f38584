"""What a run leaves: the picture under its light, its files, and the report for a person.

The report itself reads what a run has written, and computes no picture of its own.
"""
