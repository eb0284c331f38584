"""What one insertion is asked to do: `InsertConfig`, plain values only.

Each field is one flag of the command line (``camera_height`` is ``--camera-height``), one key of a
configuration file and one entry under ``config`` in ``run.json``. The line below a field is its
``--help``. Angles are degrees here and at the command line, radians everywhere inside.
"""

import math
import os
import re
from collections.abc import Container, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from functools import cache
from numbers import Integral, Real
from os import PathLike
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints

from warpir.app.optimize_settings import OptimizeSettings
from warpir.core.errors import ExitCode, InputError, raise_all
from warpir.core.limits import LIMITS, Limits
from warpir.diffusion.prompts import make_prompts
from warpir.diffusion.settings import (
    GuidanceChoices,
    GuidanceSettings,
    ModelSettings,
    PersonalizeSettings,
)

SKY_PRESETS = ("clear", "overcast", "sunset")
REFINE_STEPS = {"material": 300, "emission": 300, "tone": 200}
REFINE_PARTS = ("base-color", "metallic", "roughness")
SEED_LIMIT = 2**32
"""Seeds are the 32-bit words that the kernels hash."""
DEVICE_FORM = re.compile(r"cpu|cuda(:\d+)?")
DEMO_HINT = "--demo needs neither --photo nor --asset"


_PLAIN = GuidanceSettings()
PRIOR_DEFAULTS: dict[str, dict[str, Any]] = {
    "stable-diffusion": {
        **{f.name: getattr(_PLAIN, f.name) for f in fields(GuidanceChoices) if f.default is None},
        "steps": 600,
        "guidance_width": 384,
        "light_height": 64,
        "object_light_height": 32,
        "personalize": True,
        "fusion": "schedule",
        "lobe_shape": True,
        "tone_curve": True,
        "rate": 1.0,
        "accept": False,
        "preview_every": 0,
        "tone": "reinhard",
    },
    # What the prior's potential is least biased for (benchmarks/probe.py): the photo's own share in
    # what it expects, at noise levels of .76 to .99. One light and no curves: a small prior cannot
    # tell more apart, and it learnt from photos that are clipped, not bent.
    "embedded": {
        "loss": "sds-base",
        "guidance_scale": 4.0,
        "null_background": "drop",
        "time_min": 0.55,
        "time_max": 0.9,
        "time_max_end": 0.9,
        "weight": "sigma",
        "noises": 4,
        "crop_min": 1.3,
        "crop_max": 4.0,
        "fusion": "single",
        "lobe_shape": False,
        "tone_curve": False,
        "rate": 0.35,
        "steps": 0,
        "guidance_width": 384,
        "light_height": 64,
        "object_light_height": 32,
        "personalize": False,
        "accept": True,
        "preview_every": 50,
        # What it learnt from is clipped as photos are.
        "tone": "linear",
    },
}
"""What a field that is None stands for, by the prior that guides."""
EMBEDDED_STEPS = 60
"""Steps with which the embedded prior was tried; it is not asked unless --steps says so."""
CPU_DEFAULTS: dict[str, dict[str, Any]] = {
    "stable-diffusion": {},
    "embedded": {
        "noises": 2, "guidance_width": 256, "light_height": 48, "object_light_height": 24,
    },
}  # fmt: skip
"""What it stands for on the CPU, where that differs."""


@dataclass(frozen=True)
class InsertConfig(ModelSettings, PersonalizeSettings, GuidanceChoices, OptimizeSettings):
    """One insertion. Checked for ranges and finiteness when made; files are checked later.

    Raises:
        InputError: A value is out of range, or two values exclude each other
            (`ExitCode.USAGE`; further problems are in ``also``).
    """

    photo: str | None = None
    """The photograph: JPEG, PNG, TIFF, WebP, EXR or Radiance HDR"""
    layer: str | None = None
    """Layer of an EXR photo that is used, such as beauty for beauty.R, beauty.G and beauty.B
    (default: its R, G and B)"""
    occluder_mask: str | None = None
    """Grey image of the upright photo's size: white where the photo stays in front of the object"""
    asset: str | None = None
    """The object: .glb, .gltf, .obj, .ply or .stl"""
    out: str | None = None
    """Folder for everything that is written"""
    overwrite: bool = False
    """Replace results that are already in --out"""
    asset_up: str | None = None
    """Which axis of the asset points up (default: +y, as glTF demands; other tools' OBJ, PLY and
    STL are often +z)"""
    materials: str | None = None
    """materials.json of a run with --refine: factors for the materials of --asset"""
    demo: bool = False
    """Use the scene that ships with warpir in place of --photo and --asset"""

    camera: str | None = None
    """Camera of the photo: warpir's JSON, .fspy or fSpy's JSON, a COLMAP model's folder, the
    transforms.json of nerfstudio, Waymo's calibration, glTF or EXR (default: the photo's EXIF)"""
    frame: str | None = None
    """Which image or camera of the camera file is meant (default: the one named as the photo)"""
    undistort: bool = False
    """Undo the lens distortion that the camera file states; the composite is of the straight
    photo"""
    fov: float | None = None
    """Horizontal field of view of the photo [deg]"""
    pitch: float | None = None
    """How far the camera looks up, negative for down [deg]"""
    horizon: float | None = None
    """Row of the horizon in the photo's middle column, from the top [px], or its share of the
    height when between 0 and 1; in place of --pitch"""
    camera_height: float | None = None
    """Height of the camera above the ground [m]"""
    up: str | None = None
    """Which axis of the camera file's world points up"""
    ground: tuple[float, float, float, float] | None = None
    """Ground plane a x + b y + c z + d = 0 in world coordinates [1, 1, 1, m] (default: y = 0)"""
    ground_points: str | None = None
    """Points of the scene in the camera file's world (.ply, text, COLMAP model): the ground is a
    plane fitted to them, and without --at and --place the object stands where it is free"""
    proxy: str | None = None
    """Mesh of the place in world coordinates [m], +Y up: .glb, .gltf, .obj, .ply or .stl. It
    receives shadows beside the ground plane, hides the object and stands in the light's way"""
    plane: bool = True
    """The ground plane beside the mesh of --proxy"""
    shadow_mask: str | None = None
    """Grey image of the photo's size, white where its ground is in shadow already: the sun and
    other lamps are not taken away there once more"""

    place: tuple[float, float, float] | None = None
    """Where the object stands, world coordinates [m]; moved onto the ground along its normal (not
    with --no-plane)"""
    at: tuple[float, float] | None = None
    """Where the object stands, as a pixel of the ground or of --proxy in the upright photo [px]"""
    rotate_y: float = 0.0
    """Turn of the object about the ground's normal, counter-clockwise seen from above [deg]"""
    scale: float | None = None
    """Factor on the asset's own size [1]"""
    size: float | None = None
    """Longest side of the asset's bounding box after scaling [m]"""

    light: str | None = None
    """The light: a panorama (.hdr, .exr, or a picture without a sun's strength) or lobes (.json)"""
    light_convention: str = "openexr"
    """Who made the panorama, which tells where its seam lies: openexr (also OpenUSD and Mitsuba),
    nvdiffrec, threejs, blender, or diffusionlight, whose maps turn with the camera"""
    light_rotate: float = 0.0
    """Turn of the light about +Y, counter-clockwise seen from above [deg]"""
    fit_lobes: int | None = None
    """Replace the panorama by this many spherical-Gaussian lobes fitted to it"""
    sun: tuple[float, float] | tuple[float, float, float] | None = None
    """A sun: azimuth clockwise from -Z seen from above [deg], elevation [deg], irradiance it
    gives a surface that faces it, relative [W/m^2]"""
    sky: str | tuple[float, float, float] | None = None
    """A sky: clear, overcast or sunset, or its linear radiance R,G,B, relative [W/(m^2 sr)]"""
    exposure: float | None = None
    """Factor on the light, in stops [EV] (default: chosen from the photo)"""

    tone: str | None = None
    """How the object's radiance becomes display values: linear (clipped, as the photo was), or
    reinhard (x / (1 + x), paler, nothing clips)"""
    ground_albedo: float = 0.25
    """Reflectance assumed of the ground, for the automatic exposure [1]"""

    samples: int = 64
    """Samples per pixel"""
    rays: int = 1
    """Rays per sample of each sampling strategy, light and surface"""
    depth: int = 5
    """Longest light path, in surface hits"""
    indirect_limit: float = 8.0
    """Most radiance that one light path may add after its first bounce; 0: no limit (the limit
    removes bright specks where a mirror throws sunlight onto the object)"""
    width: int | None = None
    """Width at which the object is rendered [px] (default: the photo's)"""
    device: str | None = None
    """cpu, cuda or cuda:N (default: cuda where there is one, else cpu)"""
    threads: int | None = None
    """CPU threads (default: one per core)"""
    seed: int = 0
    """Seed of all random numbers"""
    deterministic: bool = False
    """Repeat the same bytes on a GPU too, slower; on the CPU every run does"""

    alpha: str = "refuse"
    """What to do with a photo that has transparency: refuse or ignore"""
    max_pixels: int = LIMITS.pixels
    """Largest photo or mask that is opened [px]"""
    max_envmap_width: int = LIMITS.envmap_width
    """Widest panorama that is opened [px]"""
    strict: bool = False
    """Refuse a photo or panorama with values that are not finite, or a light with negative ones,
    in place of repairing them"""
    max_file_bytes: int = LIMITS.file_bytes
    """Largest mesh, texture, point cloud or file of a COLMAP model that is read [byte]"""
    max_triangles: int = LIMITS.triangles
    """Largest asset or proxy that is read, instances counted [triangles]"""
    max_texture_pixels: int = LIMITS.texture_pixels
    """Most pixels of all textures of the asset together [px]"""
    max_nodes: int = LIMITS.nodes
    """Most nodes of a glTF file"""
    max_instances: int = LIMITS.instances
    """Most meshes that a glTF file places, each instance counted"""
    max_points: int = LIMITS.points
    """Most points of --ground-points"""
    max_json_bytes: int = LIMITS.json_bytes
    """Largest JSON file: configuration, camera, lobes, materials, sequence [byte]; of YAML, which
    takes longer to read, a 256th"""
    max_gltf_json_bytes: int = LIMITS.gltf_json_bytes
    """Largest JSON of a glTF file [byte]"""
    max_json_values: int = LIMITS.json_values
    """Most values in a JSON file, lists and objects counted"""
    max_nesting: int = LIMITS.nesting
    """Most levels of lists and objects within each other in JSON and YAML"""
    max_prompt_bytes: int = 4096
    """Longest prompt [byte]"""
    missing_textures: str = "error"
    """What to do when a texture of the asset is missing: error, or grey in its place"""
    detail: bool = True
    """Let the object reflect what the photo shows of its surroundings, where the light has no
    panorama's detail of its own"""
    mark: bool = True
    """Note in the picture's metadata that it is a composite"""
    hand_off: bool = True
    """Write the files for Blender, three.js and colour tools as well"""
    report: bool = True
    """Write report.html, a page that shows the result, the light and all figures"""
    mitsuba: bool = False
    """Write the insertion as a scene of Mitsuba 3 as well, into a folder of its own"""

    guidance: str | None = None
    """What recovers the light from the photo: embedded, what comes with warpir: the light that a
    regressor sees in the photo, which with --steps 60 a small prior refines (experimental: it
    failed its release gate); stable-diffusion; or none, and the light is used as given, or else as
    the regressor sees it (default: stable-diffusion with --model, none where a light is given, else
    embedded)"""
    prompt: str | None = None
    """What the object is, in a few words, such as 'a black SUV car' (stable-diffusion needs it)"""
    prior: str | None = None
    """Weights of the prior of --guidance embedded, which --steps asks (default: those in the
    package)"""
    regressor: str | None = None
    """Weights of the regressor (default: those that come with warpir)"""
    start: str | None = None
    """Where the recovery begins when no light is given: regressed, as the regressor sees it in the
    photo, or uniform, an even light (default: regressed)"""
    accept: bool | None = None
    """Keep the start of the recovery unless guidance, asked anew, clearly prefers its end"""
    show_prior: tuple[str, ...] | None = None
    """Prompts, separated by |, for pictures of what the model imagines, before and after it was
    adapted to the photo"""
    preview_every: int | None = None
    """Steps between two preview pictures of the optimisation, the first of which is the start;
    0: none"""
    checkpoint_every: int = 50
    """Steps between two checkpoints of the optimisation; 0: none"""
    resume: bool = False
    """Go on from the last checkpoint in --out"""

    reuse: str | None = None
    """Folder of an earlier run: its light and its tone curves are used, and nothing is optimised"""
    sequence: str | None = None
    """JSON lines, each a frame: what differs from the command line, such as {"photo": "2.png",
    "place": [0, 0, -4]}; needs --reuse"""
    fps: float = 24.0
    """Frames per second of the video of --sequence, which is made where ffmpeg is found"""
    refine: str | None = None
    """What is changed by the prompt under a known light (--reuse, --light, --sun or --sky):
    material, emission or tone"""
    refine_parts: tuple[str, ...] | None = None
    """What --refine material changes: base-color, metallic, roughness (default: all of them)"""
    refine_materials: tuple[str, ...] | None = None
    """Names of the asset's materials that --refine changes (default: all of them)"""

    def __post_init__(self) -> None:
        """Check everything that can be checked without opening a file."""
        for field in fields(self):
            # Frozen for everybody else.
            object.__setattr__(self, field.name, _plain(getattr(self, field.name)))
        raise_all([*_values_out_of_range(self), *_values_that_clash(self)])

    @property
    def limits(self) -> Limits:
        """What each input may cost."""
        return Limits(**{f.name: getattr(self, f"max_{f.name}") for f in fields(Limits)})

    @property
    def guided_by(self) -> str:
        """``guidance``, or what stands for it: embedded, stable-diffusion or none."""
        if self.guidance is not None:
            return self.guidance
        if self.model is not None:
            return "stable-diffusion"
        is_lit = any(getattr(self, name) is not None for name in LIGHTS)
        return "none" if is_lit else "embedded"

    @property
    def is_light_described(self) -> bool:
        """Whether the user said anything about the light."""
        return any(v is not None for v in (self.light, self.sun, self.sky))

    @property
    def is_guided(self) -> bool:
        """Whether a prior is asked: the embedded one is where `steps` says how often."""
        return self.guided_by == "stable-diffusion" or (
            self.guided_by == "embedded" and bool(self.steps)
        )

    @property
    def tone_operator(self) -> str:
        """`tone`, or what stands for it; a light far from its start wants one that never clips."""
        return self.tone or PRIOR_DEFAULTS.get(self.guided_by, {"tone": "linear"})["tone"]

    def settled(self, on_cuda: bool = True) -> "InsertConfig":
        """Return the same with nothing left open to the prior; without one, as Stable Diffusion's.

        Args:
            on_cuda: Whether it runs on a CUDA device.
        """
        return replace(self, **_open_values(self, on_cuda))

    def guidance_settings(self) -> GuidanceSettings:
        """Return what guidance is asked to do; nothing may be open (`settled`)."""
        return GuidanceSettings(**{f.name: getattr(self, f.name) for f in fields(GuidanceSettings)})

    def require_inputs(self) -> None:
        """Check that what every run needs is named.

        Kept apart from construction so that a notebook can build a configuration in steps.

        Raises:
            InputError: A needed value is absent (`ExitCode.USAGE`).
        """
        # The lines of a sequence may name photos and assets; each frame is checked by itself.
        needed = {} if self.demo or self.sequence else dict.fromkeys(("photo", "asset"), DEMO_HINT)
        needed["out"] = ""
        if self.guided_by == "stable-diffusion":
            needed["model"] = "--guidance stable-diffusion needs a folder or a hub id"
            needed["prompt"] = "say in a few words what the object is"
        raise_all(
            [
                usage(flag(name), "needed", advice)
                for name, advice in needed.items()
                if getattr(self, name) is None
            ]
        )


def _open_values(config: InsertConfig, on_cuda: bool = True) -> dict[str, Any]:
    """Return what stands for the fields that are open; without a prior, Stable Diffusion's."""
    prior = config.guided_by if config.guided_by in PRIOR_DEFAULTS else "stable-diffusion"
    chosen = PRIOR_DEFAULTS[prior] | ({} if on_cuda else CPU_DEFAULTS[prior])
    if config.refine in REFINE_STEPS:
        chosen |= {"steps": REFINE_STEPS[config.refine], "accept": False}
    if config.lora is not None:
        chosen |= {"personalize": True}
    if prior == "embedded" and (config.lora is not None or config.personalize):
        chosen |= {"loss": "sds"}  # the same, asked of the adapted model
    if config.loss == "dataset-update":
        chosen |= {"accept": False}
    if not config.is_guided:
        del chosen["accept"]  # there is no end that could be judged
    # The tone belongs to the light: `InsertConfig.tone_operator`.
    return {k: v for k, v in chosen.items() if k != "tone" and getattr(config, k) is None}


def flag(name: str) -> str:
    """Return a field's spelling at the command line; what is on by default is switched off."""
    return ("--no-" if DEFAULTS[name] is True else "--") + name.replace("_", "-")


def usage(where: str, what: str, advice: str = "") -> InputError:
    """Make the error of a wrong command line or configuration."""
    return InputError(where, what, advice, ExitCode.USAGE)


LARGEST = 1e9
"""Of a coordinate [m] and of a light's strength; float32 products overflow from 10^19 on."""
RANGES: dict[str, tuple[float, float | None]] = {
    "pitch": (-90, 90),
    "fit_lobes": (1, 4096),
    "exposure": (-30, 30),
    "samples": (1, 2**20),
    "rays": (1, 2**10),
    "depth": (1, 2**10),
    "indirect_limit": (0, None),
    # Far beyond what anybody photographs, and products of them still fit float32.
    "camera_height": (1e-6, 1e9),
    "scale": (1e-9, 1e9),
    "size": (1e-6, 1e9),
    "ground_albedo": (1e-6, 1),
    "width": (8, 65_536),
    "threads": (1, 2**10),
    "seed": (0, SEED_LIMIT - 1),
    "fps": (1, 240),
    "max_pixels": (1, None),
    "max_envmap_width": (1, 2**20),
    "max_file_bytes": (1, None),
    "max_triangles": (1, None),
    "max_texture_pixels": (1, None),
    "max_nodes": (1, None),
    "max_instances": (1, None),
    "max_points": (1, None),
    "max_json_bytes": (1, None),
    "max_gltf_json_bytes": (1, None),
    "max_json_values": (1, None),
    # Python's readers call themselves for each level.
    "max_nesting": (1, 200),
    "max_prompt_bytes": (1, None),
    # The diffusion model, and its adaptation to the photo
    "class_images": (0, 10_000),
    "class_steps": (1, 1000),
    "class_scale": (0, 1000),
    "class_batch": (1, 256),
    "lora_rank": (1, 1024),
    "lora_steps": (0, 10**6),
    "lora_rate": (0, 1),
    "lora_class_batch": (1, 64),
    "lora_class_weight": (0, 1000),
    "lora_crop": (0.05, 1),
    "lora_decay": (0, 1),
    "lora_clip": (1e-9, None),
    # Guidance
    "guidance_scale": (0, 10_000),
    "time_min": (0, 1),
    "time_max": (0, 1),
    "time_max_end": (0, 1),
    "noises": (1, 64),
    "crop_min": (0.01, 100),
    "crop_max": (0.01, 100),
    "gradient_clip": (0, None),
    "update_every": (1, 10**6),
    "update_steps": (1, 1000),
    "update_scale": (0, 1000),
    # Optimisation
    "steps": (0, 10**6),
    "guidance_width": (8, 4096),
    "lobes": (1, 4096),
    "light_height": (4, 512),
    "object_light_height": (4, 512),
    "transport_memory": (1, 2**24),
    "mis_samples": (1, 2**20),
    "retrace_at": (1, None),
    "rate": (0, 10),
    "rate_intensity": (0, 10),
    "rate_axis": (0, 10),
    "rate_width": (0, 10),
    "rate_chroma": (0, 10),
    "rate_tone": (0, 10),
    "rate_material": (0, 10),
    "rate_emission": (0, 10),
    "adam_beta1": (0, 0.999999),
    "adam_beta2": (0, 0.999999),
    "consistency": (0, None),
    "spread": (0, None),
    "chroma": (0, None),
    "bend": (0, None),
    "trust": (0, None),
    "tone_bins": (1, 64),
    "fusion_start": (0, 1),
    "fusion_end": (0, 1),
    "rate_end": (0, 1),
    "lobe_width": (0.05, 10),
    "chroma_limit": (0, 20),
    "intensity_limit": (1, 1e12),
    "score_every": (0, 10**6),
    "preview_every": (0, 10**6),
    "checkpoint_every": (0, 10**6),
}
"""Least and greatest value of a field; None: no limit."""

ABOVE_ZERO = ("lora_rate", "chroma_limit")

AXES = ("x", "+x", "-x", "y", "+y", "-y", "z", "+z", "-z")
CHOICES = {
    "up": AXES,
    "asset_up": AXES,
    "tone": ("reinhard", "linear"),
    "alpha": ("refuse", "ignore"),
    "light_convention": ("openexr", "nvdiffrec", "threejs", "blender", "diffusionlight"),
    "missing_textures": ("error", "grey"),
    "guidance": ("embedded", "stable-diffusion", "none"),
    "start": ("regressed", "uniform"),
    "precision": ("fp16", "bf16", "fp32"),
    "vae_precision": ("fp16", "bf16", "fp32"),
    "loss": (
        "lds",
        "sds",
        "sds-base",
        "csd",
        "lds-lora-both",
        "lds-negative",
        "good-bad",
        "sds-good-bad",
        "dataset-update",
    ),
    "null_background": ("keep", "drop"),
    "weight": ("sigma2", "sigma", "uniform"),
    "fusion": ("schedule", "single", "none"),
    "integrator": ("transport", "mis"),
    "refine": ("material", "emission", "tone"),
}
LOSSES_OF_BASE = ("csd", "sds-base", "good-bad", "sds-good-bad", "dataset-update")
"""Losses that do without an adapter."""
LOSSES_AWAY = ("lds-negative", "good-bad", "sds-good-bad")
"""Losses that move away from a negative prompt."""
LIGHTS = ("light", "sun", "sky", "reuse")
"""Fields that name a light."""
PROMPTS = (
    "prompt",
    "negative_prompt",
    "null_prompt",
    "base_prompt",
    "class_noun",
    "token",
    "show_prior",
)
EMPTY_ALLOWED = ("negative_prompt", "null_prompt", "base_prompt")


@cache
def _kinds() -> dict[str, Any]:
    """Return the annotations of all fields."""
    return get_type_hints(InsertConfig)


def _plain(value: object) -> object:
    """Return a value as JSON holds it: a path as text, NumPy's numbers as Python's."""
    if isinstance(value, tuple | list):
        return tuple(map(_plain, value))
    if isinstance(value, PathLike):
        return os.fspath(value)
    if isinstance(value, bool | str):
        return value
    if isinstance(value, Integral):
        return int(value)
    return float(value) if isinstance(value, Real) else value


def _is_a(value: object, kind: Any) -> bool:
    """Return whether a plain value is what an annotation says; a whole number is a float too."""
    if get_origin(kind) is UnionType:
        return any(_is_a(value, alternative) for alternative in get_args(kind))
    if get_origin(kind) is tuple:
        parts = get_args(kind)
        if not isinstance(value, tuple):
            return False
        parts = parts[:1] * len(value) if parts[-1] is Ellipsis else parts
        return len(parts) == len(value) and all(map(_is_a, value, parts))
    if kind is bool or isinstance(value, bool):
        return kind is bool and isinstance(value, bool)
    return isinstance(value, int | float if kind is float else kind)


def _values_out_of_range(config: InsertConfig) -> Iterator[InputError]:
    def check(name: str, accepted: bool, expected: str) -> Iterator[InputError]:
        value = getattr(config, name)
        # A NaN fails every comparison and is reported as not finite.
        if value is not None and value == value and not accepted:
            yield usage(flag(name), f"{expected} (found {_shown(value)})")

    values = {field.name: getattr(config, field.name) for field in fields(config)}
    of_other_kinds = [name for name, value in values.items() if not _is_a(value, _kinds()[name])]
    for name in of_other_kinds:
        expected = str(_kinds()[name]).removeprefix("<class '").removesuffix("'>")
        yield usage(flag(name), f"expected {expected} (found {_shown(values[name])})")
    if of_other_kinds:
        return  # from Python alone, and no other check would know what to do with them
    for name, value in values.items():
        yield from _not_plain(name, value, config.max_prompt_bytes)
    yield from check("fov", config.fov is None or 0.0 < config.fov < 180.0, "between 0 and 180")
    in_order = config.fusion_end >= config.fusion_start
    yield from check("fusion_end", in_order, "at least --fusion-start")
    for name in ("place", "ground", "sun", "sky", "at"):
        parts = values[name]
        if isinstance(parts, tuple):
            within = not any(abs(part) > LARGEST for part in parts)
            yield from check(name, within, f"numbers up to {LARGEST:g}")
    if config.ground is not None and all(map(math.isfinite, config.ground)):
        yield from check("ground", any(config.ground[:3]), "a normal a,b,c that is not 0")
    if config.sun is not None:
        yield from check("sun", -90.0 <= config.sun[1] <= 90.0, "elevation -90 to 90")
        yield from check("sun", len(config.sun) < 3 or config.sun[-1] >= 0.0, "strength at least 0")
    if isinstance(config.sky, tuple):
        yield from check("sky", min(config.sky) >= 0.0, "radiance at least 0")
    else:
        presets = f"{', '.join(SKY_PRESETS)} or R,G,B"
        yield from check("sky", config.sky in SKY_PRESETS, presets)
    if config.device is not None:
        known = DEVICE_FORM.fullmatch(config.device) is not None
        yield from check("device", known, "cpu, cuda or cuda:N")
    if config.prompt and config.token:
        try:
            make_prompts(config.prompt, config)
        except ValueError as error:
            name, _, what = str(error).partition(": ")
            yield usage(flag(name), what)
    if config.refine_parts is not None:
        known = set(config.refine_parts) <= set(REFINE_PARTS)
        yield from check("refine_parts", known, f"some of {', '.join(REFINE_PARTS)}")
    for name, value in values.items():
        if value is None:
            continue
        if name in ABOVE_ZERO:
            yield from check(name, value > 0.0, "more than 0")
        if name in RANGES:
            low, high = RANGES[name]
            yield from check(name, value >= low, f"at least {low}")
            yield from check(name, high is None or value <= high, f"at most {high}")
        if name in CHOICES:
            yield from check(name, value in CHOICES[name], " or ".join(CHOICES[name]))


def _not_plain(name: str, value: object, prompt_limit: int) -> Iterator[InputError]:
    """Find numbers that are not finite and texts that no file or model can be asked for."""
    parts = value if isinstance(value, tuple) else (value,)
    if any(isinstance(part, float) and not math.isfinite(part) for part in parts):
        yield usage(flag(name), f"finite numbers (found {_shown(value)})")
    texts = [part for part in parts if isinstance(part, str)]
    if not parts or any("\0" in t or not (t or name in EMPTY_ALLOWED) for t in texts):
        yield usage(flag(name), "a text that is not empty and holds no NUL")
    longest = max((len(text.encode("utf-8", "replace")) for text in texts), default=0)
    if name in PROMPTS and longest > prompt_limit:
        found = f"a text too long (found {longest} bytes; limit {prompt_limit})"
        yield usage(flag(name), f"{found}; --max-prompt-bytes raises it")


EXCLUSIVE = (
    ("demo", "photo"),
    ("demo", "asset"),
    ("demo", "camera"),
    ("camera", "fov"),
    ("camera", "pitch"),
    ("camera", "horizon"),
    ("camera", "camera_height"),
    ("pitch", "horizon"),
    ("ground", "ground_points"),
    ("place", "at"),
    ("scale", "size"),
    ("light", "sun"),
    ("light", "sky"),
    ("light", "start"),
    ("sun", "start"),
    ("sky", "start"),
    ("reuse", "start"),
    ("reuse", "demo"),
    ("reuse", "light"),
    ("reuse", "sun"),
    ("reuse", "sky"),
    ("sequence", "refine"),
    ("resume", "overwrite"),
)
"""Pairs of fields of which at most one may be given."""


def replaced_by(changes: Mapping[str, Any], among: Container[str]) -> dict[str, Any]:
    """Return what changes leave no room for, at its default: "at" on a line replaces --place.

    Args:
        changes: Values by their fields, which replace others.
        among: Fields that may be given up for them.
    """
    return {
        other: DEFAULTS[other]
        for pair in EXCLUSIVE
        for name, other in (pair, pair[::-1])
        if changes.get(name) is not None and other in among and other not in changes
    }


def _values_that_clash(config: InsertConfig) -> Iterator[InputError]:
    def given(name: str) -> bool:
        return bool(getattr(config, name) != DEFAULTS[name])

    def needs(name: str, fulfilled: bool, what: str) -> Iterator[InputError]:
        if given(name) and not fulfilled:
            yield usage(flag(name), f"needs {what}")

    for first, second in EXCLUSIVE:
        if given(first) and given(second):
            yield usage(flag(second), f"cannot be used with {flag(first)}", "leave one of them out")
    guided, with_words = config.guided_by != "none", config.guided_by == "stable-diffusion"
    if given("reuse") and guided and not given("refine"):
        yield usage(
            "--guidance" if given("guidance") else "--model",
            "cannot be used with --reuse, whose light is known",
            "leave one of them out, or say with --refine what is to change under that light",
        )
    yield from needs("plane", given("proxy"), "--proxy, without which there is no other ground")
    if given("shadow_mask") and config.is_guided:
        yield usage(
            "--shadow-mask",
            "cannot be used while a prior changes the light or the object",
            "recover the light first, then give the mask with --reuse",
        )
    yield from needs("mitsuba", config.hand_off, "the files that --no-hand-off leaves out")
    yield from needs("fit_lobes", given("light"), "--light with a panorama to fit")
    yield from needs("light_convention", given("light"), "--light with a panorama")
    yield from needs("up", given("camera"), "--camera; without a camera file the world is Y up")
    for name in ("frame", "undistort", "ground_points"):
        yield from needs(name, given("camera"), "--camera with a camera file")
    yield from needs("sequence", given("reuse"), "--reuse: one light for all frames")
    yield from needs("fps", given("sequence"), "--sequence, of which the video is made")
    yield from needs("show_prior", with_words, "--guidance stable-diffusion and its --model")
    if given("show_prior") and with_words and config.personalize is False:
        yield usage("--no-personalize", "cannot be used with --show-prior, which shows its effect")
    if given("lora") and config.personalize is False:
        yield usage("--no-personalize", "cannot be used with --lora", "leave one of them out")
    asks = f"--guidance with a prior (--model, or --steps {EMBEDDED_STEPS} for the embedded one)"
    yield from needs("resume", config.is_guided, f"{asks}: nothing else has checkpoints")
    asks_embedded = config.is_guided and not with_words
    steps = f"--guidance embedded and --steps {EMBEDDED_STEPS}: the prior is not asked without"
    yield from needs("prior", asks_embedded, steps)
    yield from needs("accept", config.is_guided, f"{asks}, whose result it judges")
    is_demo_lit = given("demo") and (not guided or given("refine"))
    lit = any(map(given, LIGHTS)) or is_demo_lit
    level = "--light, --sun or --sky: with --guidance alone the light's level is recovered"
    yield from needs("exposure", lit or not config.is_guided, level)
    turned = given("light") or given("reuse") or is_demo_lit
    yield from needs("light_rotate", turned, "--light or --reuse; of --sun, give another azimuth")
    yield from needs("refine", lit, "a known light: --reuse, --light, --sun or --sky")
    who_judges = "--guidance stable-diffusion, which judges the change: no other knows colours"
    yield from needs("refine", with_words, who_judges)
    yield from needs("refine_parts", config.refine == "material", "--refine material")
    with_materials = config.refine in ("material", "emission")
    yield from needs("refine_materials", with_materials, "--refine material or emission")
    if config.refine == "tone" and config.tone_curve is False:
        yield usage(
            "--no-tone-curve", "cannot be used with --refine tone, which changes nothing else"
        )
    yield from _losses_that_clash(config)


def _losses_that_clash(config: InsertConfig) -> Iterator[InputError]:
    """Find what a loss lacks, and ranges that are empty; with what is open as the prior has it."""
    made = {**vars(config), **_open_values(config)}
    loss = made["loss"]
    if config.guided_by != "none" and not made["personalize"] and loss not in LOSSES_OF_BASE:
        losses = " or ".join(LOSSES_OF_BASE)
        if config.personalize is False:
            yield usage(
                "--no-personalize",
                f"cannot be used with --loss {loss}, which compares the adapted model",
                f"add --loss {losses}, or leave it out",
            )
        else:
            what = f"{loss} compares the adapted model"
            yield usage("--loss", what, f"add --personalize, or choose {losses}")
    says_itself = config.guided_by == "embedded" or config.negative_prompt
    if loss in LOSSES_AWAY and not says_itself:
        yield usage("--loss", f"{loss} needs --negative-prompt, which it moves away from")
    if config.accept and loss == "dataset-update":
        yield usage("--accept", "cannot be used with --loss dataset-update, which has no potential")
    for low, high in (("time_min", "time_max"), ("crop_min", "crop_max")):
        least, greatest = made[low], made[high]
        if least > greatest:
            yield usage(flag(low), f"at most {flag(high)} (found {least:g} and {greatest:g})")


def _shown(value: object) -> str:
    if isinstance(value, tuple):
        value = ",".join(f"{p:g}" if isinstance(p, int | float) else str(p) for p in value)
    text = str(value)
    return text if len(text) <= 60 else text[:57] + "..."


DEFAULTS = {field.name: field.default for field in fields(InsertConfig)}
"""What a field holds when nobody names it."""
