"""The nodes, in ComfyUI's documented interface; all work is warpir's.

https://docs.comfy.org/custom-nodes/backend/server_overview says what a node has to state.
"""

import json
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

Spec = dict[str, dict[str, tuple[Any, ...]]]
MAP_HEIGHT = 256
"""Rows of a light map [px]."""


def _photo(image: Tensor) -> np.ndarray:
    """Return the first image of a batch, shape [H, W, 3], float32 in [0, 1]."""
    photo: np.ndarray = image[0, :, :, :3].clamp(0.0, 1.0).cpu().numpy()
    return photo


def _image(codes: np.ndarray) -> Tensor:
    """Return codes of 8 or 16 bits, shape [H, W, 3], as a batch of one image."""
    return torch.from_numpy(codes.astype(np.float32) / np.iinfo(codes.dtype).max)[None]


def _output(name: str) -> Path:
    """Return a new folder below ComfyUI's output, or below the temporary one outside of it."""
    try:
        import folder_paths  # ComfyUI's own module

        root = Path(folder_paths.get_output_directory())
    except ImportError:
        root = Path(tempfile.gettempdir())
    root.mkdir(parents=True, exist_ok=True)
    return Path(tempfile.mkdtemp(prefix=f"warpir-{name}-", dir=root))


def _stop_if_cancelled() -> Callable[[], object]:
    """Return what raises once ComfyUI's user has cancelled; outside of ComfyUI nothing does."""
    try:
        from comfy.model_management import throw_exception_if_processing_interrupted as stop
    except ImportError:
        return lambda: None
    return stop


def _is_of_a_node(light: str) -> bool:
    """Return whether a light map is one of these nodes' results: its level is the photo's."""
    own = tuple(f"warpir-{name}-" for name in ("light", "insertion"))
    return any(part.startswith(own) for part in Path(light).parts[-3:-1])


def _camera(image: Tensor) -> Any:
    from warpir.calibration.estimate import estimate_camera

    return estimate_camera(_photo(image))


class EstimateCamera:
    """Pitch, roll and field of view of an image, each with its standard deviation."""

    DESCRIPTION = __doc__
    CATEGORY = "warpir"
    FUNCTION = "run"
    RETURN_TYPES = ("FLOAT", "FLOAT", "FLOAT", "FLOAT", "STRING")
    RETURN_NAMES = ("pitch_deg", "roll_deg", "vertical_fov_deg", "horizon", "summary")
    OUTPUT_TOOLTIPS = (
        "Upward tilt; negative looks down [deg]",
        "Positive lets the horizon fall to the right [deg]",
        "Vertical field of view [deg]",
        "The horizon's height in the middle column, a share of the image from its top",
        "The numbers with their standard deviations",
    )

    @classmethod
    def INPUT_TYPES(cls) -> Spec:
        return {"required": {"image": ("IMAGE", {"tooltip": "One photo; of a batch the first"})}}

    def run(self, image: Tensor) -> tuple[float, float, float, float, str]:
        found = _camera(image)
        focal = 0.5 / np.tan(np.radians(found.vfov_deg) / 2.0)
        lean = np.tan(np.radians(found.pitch_deg)) / np.cos(np.radians(found.roll_deg))
        horizon = float(found.principal[1] + focal * lean)
        summary = (
            f"pitch {found.pitch_deg:.1f} +- {found.pitch_sigma_deg:.1f}, "
            f"roll {found.roll_deg:.1f} +- {found.roll_sigma_deg:.1f}, "
            f"vertical field of view {found.vfov_deg:.1f} +- {found.vfov_sigma_deg:.1f} degrees"
        )
        return found.pitch_deg, found.roll_deg, found.vfov_deg, horizon, summary


class EstimateLight:
    """The light of an image: an HDR map as a file, its preview, two balls, and numbers."""

    DESCRIPTION = __doc__
    CATEGORY = "warpir"
    FUNCTION = "run"
    RETURN_TYPES = ("STRING", "IMAGE", "IMAGE", "FLOAT", "FLOAT", "FLOAT", "STRING")
    RETURN_NAMES = ("light", "map", "balls", "azimuth", "elevation", "spread", "numbers")
    OUTPUT_TOOLTIPS = (
        "The map as OpenEXR, linear, for the light input of Insert object",
        "The map as a picture: what the camera looks at is in the middle",
        "A mirror ball and a grey ball in the light",
        "Of the main light, from straight ahead to the right [deg]",
        "Of the main light above the horizon [deg]",
        "How far off its direction is expected to be [deg]",
        "All numbers as JSON",
    )

    @classmethod
    def INPUT_TYPES(cls) -> Spec:
        return {"required": {"image": ("IMAGE", {"tooltip": "One photo; of a batch the first"})}}

    def run(self, image: Tensor) -> tuple[str, Tensor, Tensor, float, float, float, str]:
        from warpir.io.images.writers import envmap_exr_bytes, envmap_preview
        from warpir.lighting.regression import regress
        from warpir.lighting.regressor import load_regressor
        from warpir.lighting.visible_sun import with_visible_sun
        from warpir.render.picture.light_preview import balls
        from warpir.scene.light import Light, angles_from_axis, as_map

        photo = _photo(image)
        camera = _camera(image).camera(photo.shape[1], photo.shape[0], 1.6)
        found = with_visible_sun(regress(load_regressor(None), photo, camera), photo, camera)
        light = Light(lobes=found.lobes())
        texels = as_map(light, MAP_HEIGHT)
        path = _output("light") / "envmap.exr"
        path.write_bytes(envmap_exr_bytes(path, texels))
        azimuth, elevation = angles_from_axis(found.axis)
        pictures = _image(envmap_preview(texels)), _image(balls(light, camera, False))
        numbers = json.dumps(found.record())
        return str(path), *pictures, azimuth, elevation, found.spread_deg, numbers


class InsertObject:
    """Put a 3D object into an image: the composite, its mask, its layers and the light."""

    DESCRIPTION = __doc__
    CATEGORY = "warpir"
    FUNCTION = "run"
    OUTPUT_NODE = True
    RETURN_TYPES = ("IMAGE", "MASK", "IMAGE", "IMAGE", "STRING", "STRING")
    RETURN_NAMES = ("composite", "mask", "object", "shadow", "light", "folder")
    OUTPUT_TOOLTIPS = (
        "The photo with the object",
        "Where the object is, in [0, 1]",
        "The object alone, linear light, premultiplied",
        "What the shadow leaves of the ground's light, per channel",
        "The light as OpenEXR",
        "The folder of all results; open its report.html",
    )

    @classmethod
    def INPUT_TYPES(cls) -> Spec:
        def number(
            default: float, low: float, high: float, tip: str, step: float = 0.01
        ) -> tuple[Any, ...]:
            # The front end rounds what is typed to the step's decimals
            about = {"default": default, "min": low, "max": high, "step": step, "tooltip": tip}
            return ("FLOAT", about)

        def text(tip: str) -> tuple[Any, ...]:
            return ("STRING", {"default": "", "tooltip": tip})

        tips = "Its file: glTF, OBJ, PLY or STL"
        return {
            "required": {
                "image": ("IMAGE", {"tooltip": "One photo; of a batch the first"}),
                "asset": ("STRING", {"default": "", "tooltip": tips}),
            },
            "optional": {
                "at_x": number(-1.0, -1.0, 1.0, "Column where it stands, share; -1: chosen", 1e-3),
                "at_y": number(-1.0, -1.0, 1.0, "Row of the ground where it stands, a share", 1e-3),
                "size": number(0.0, 0.0, 1000.0, "Its longest side [m]; 0: as the file has it"),
                "rotate_y": number(0.0, -360.0, 360.0, "Turn about the vertical [deg]"),
                "light": text("A light map; empty: estimated from the photo"),
                "camera": text("A camera file; empty: estimated from the photo"),
                "occluder": ("MASK", {"tooltip": "What stands in front of the object"}),
                "model": text("A folder of Stable Diffusion that guides the light; empty: none"),
                "prompt": text("What the object is, in a few words; with a model"),
                "samples": ("INT", {"default": 0, "min": 0, "max": 4096, "tooltip": "0: auto"}),
                "seed": ("INT", {"default": 0, "min": 0, "max": 2**31 - 1, "tooltip": "Of noise"}),
            },
        }

    def run(
        self,
        image: Tensor,
        asset: str,
        at_x: float = -1.0,
        at_y: float = -1.0,
        occluder: Tensor | None = None,
        **asked: Any,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, str, str]:
        from PIL import Image

        from warpir import insert
        from warpir.app.config import InsertConfig
        from warpir.core.progress import asking

        if (at_x < 0.0) != (at_y < 0.0):
            raise ValueError("at_x and at_y: give both, or leave both at -1")
        folder = _output("insertion")
        photo = _photo(image)
        Image.fromarray(np.uint8(np.round(photo * 255.0))).save(folder / "photo.png")
        values = {name: value for name, value in asked.items() if value not in ("", 0.0)}
        values |= {"photo": str(folder / "photo.png"), "asset": asset}
        values["out"] = str(folder / "result")
        if _is_of_a_node(values.get("light", "")):
            values["exposure"] = 0.0
        if at_x >= 0.0:
            values["at"] = (at_x * photo.shape[1], at_y * photo.shape[0])
        # A photo without alpha has an empty mask, of no particular size.
        if occluder is not None and bool(occluder.any()):
            share = occluder.reshape(-1, *occluder.shape[-2:])[0].cpu().numpy()
            Image.fromarray(np.uint8(np.round(share * 255.0))).save(folder / "occluder.png")
            values["occluder_mask"] = str(folder / "occluder.png")
        # ComfyUI runs nodes without derivatives, and a model guides by nothing else.
        with torch.inference_mode(False), asking(_stop_if_cancelled()):
            found = insert(InsertConfig(**values))
        layers = found.layers()
        with Image.open(found.out / "composite.png") as picture:
            composite = _image(np.asarray(picture.convert("RGB")))
        parts = layers.matte, layers.foreground[..., :3], layers.shadow_ratio
        mask, alone, shadow = (torch.from_numpy(np.array(part, np.float32))[None] for part in parts)
        light = str(found.out / "envmap.exr")
        return composite, mask, alone, shadow, light, str(found.out)


NODE_CLASS_MAPPINGS = {
    "WarpirEstimateCamera": EstimateCamera,
    "WarpirEstimateLight": EstimateLight,
    "WarpirInsertObject": InsertObject,
}
NODE_DISPLAY_NAME_MAPPINGS = {
    "WarpirEstimateCamera": "Estimate camera (warpir)",
    "WarpirEstimateLight": "Estimate light (warpir)",
    "WarpirInsertObject": "Insert object (warpir)",
}
