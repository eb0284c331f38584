"""How well the camera of one photo is estimated, beyond what `warpir.evaluate --camera` says."""
