"""What the camera did to the scene, blur and grain: estimated from the photo, done to the object.

Nothing here knows a light, a renderer or a configuration: arrays of the photo and of the layers.
"""
