"""What was asked, checked once: configuration, command line, inputs, and the record of a run.

Knows files and records, but neither Warp nor torch: it answers before either is loaded.
"""
