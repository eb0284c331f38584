"""Makes the files of `warpir.demo`: ``python -m tools.demo.make``."""
