"""Training of the networks that warpir ships: ``python -m warpir.train``.

Makes its own scenes and batches; a run needs nothing of it.
"""
