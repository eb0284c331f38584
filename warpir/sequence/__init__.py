"""Many frames under one light: their list, their video and their page.

Knows what a finished frame looks like, but not how it is made.
"""
