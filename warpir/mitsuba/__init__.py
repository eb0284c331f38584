"""The insertion as a scene of Mitsuba 3, and the referee that renders it.

Imports Mitsuba only where it renders; shares no formula with `warpir.kernels`.
"""
