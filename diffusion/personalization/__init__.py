"""Adapting a prior to the photo: LoRA, class images, and files that other tools read.

Knows no guidance and no optimisation.
"""
