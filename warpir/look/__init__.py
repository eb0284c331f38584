"""What the camera did to the scene, blur, response and grain, done to the object; and denoising.

Nothing here knows a light, a renderer or a configuration: arrays of the photo and of the layers.
"""
