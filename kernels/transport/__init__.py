"""Light transport without a light: what each texel of a lat-long map sends into each pixel.

Light at infinity enters linearly, so a pixel's radiance is a row of numbers times the map's texels.
`foreground.trace_points` finds what the camera sees; `foreground.trace_direct` and
`foreground.trace_paths` make the rows of ``T_fg``, `receiver.trace_blocked` those of ``T_shadow``.
The host's half is `warpir.render.transport.integrator`.
"""
