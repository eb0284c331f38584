"""Training of the network that estimates cameras, on photographs cut out of panoramas.

Knows panoramas and cameras; renders nothing and needs no Warp.
"""
