"""The scenes of a manifest, several at a time: ``python -m warpir.batch``.

Knows `warpir.insert` as one call; a scene knows nothing of its batch.
"""
