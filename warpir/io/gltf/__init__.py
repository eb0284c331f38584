"""glTF 2.0: a strict gate, the reader of geometry and materials, and the writer of GLB.

Knows no other mesh format.
"""
