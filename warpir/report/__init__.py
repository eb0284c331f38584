"""Results of a run: the final render, its files and the report.

The report reads the files of a run and renders nothing.
"""
