"""What repeating the camera on the object brings: composites, pairs of them, toned photos."""
