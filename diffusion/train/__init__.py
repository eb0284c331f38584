"""Training of the embedded prior; knows nothing of where its pictures come from."""
