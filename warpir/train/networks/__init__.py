"""The networks of a photo as torch trains them; what asks them needs no torch.

Knows the answers' layout from `warpir.lighting.regressor` and `warpir.calibration.network`, and
nothing of batches, losses or schedules.
"""
