"""Scenes to learn from: their layout, light and rendering, drawn as whole batches of tensors.

Knows neither the networks nor their training.
"""
