"""How right are light and insertions? Measured where the light is known.

Measures the other rooms from outside; nothing that a run needs is here.
"""
