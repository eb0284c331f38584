"""Results of a run: the final render, its files and the report.

`result` renders; the page reads the files of a run and renders nothing.
"""
