"""warpir's nodes for ComfyUI: estimate the camera and the light of an image, insert an object.

Link or copy this folder into ``ComfyUI/custom_nodes/warpir`` and install warpir into ComfyUI's
Python (``docs/comfyui.md``). An image is ComfyUI's: float32 in [0, 1], sRGB, shape [B, H, W, 3];
of a batch the first is used.
"""

from .nodes import NODE_CLASS_MAPPINGS, NODE_DISPLAY_NAME_MAPPINGS

__all__ = ["NODE_CLASS_MAPPINGS", "NODE_DISPLAY_NAME_MAPPINGS"]
