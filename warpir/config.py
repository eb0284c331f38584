"""What one insertion is asked to do: `InsertConfig`, plain values only.

Each field is one flag of the command line (``camera_height`` is ``--camera-height``), one key of a
configuration file and one entry under ``config`` in ``run.json``. The line below a field is its
``--help``. Angles are degrees here and at the command line, radians everywhere inside.
"""

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, fields

from warpir.diffusion.prompts import make_prompts
from warpir.diffusion.settings import GuidanceSettings, ModelSettings, PersonalizeSettings
from warpir.errors import ExitCode, InputError, raise_all
from warpir.optimize_settings import OptimizeSettings

SKY_PRESETS = ("clear", "overcast", "sunset")
REFINE_STEPS = {"material": 300, "emission": 300, "tone": 200}
REFINE_PARTS = ("base-color", "metallic", "roughness")
SEED_LIMIT = 2**32
"""Seeds are the 32-bit words that the kernels hash."""
PROMPT_BYTES_LIMIT = 4096
DEVICE_FORM = re.compile(r"cpu|cuda(:\d+)?")
DEMO_HINT = "--demo needs neither --photo nor --asset"


@dataclass(frozen=True)
class InsertConfig(ModelSettings, PersonalizeSettings, GuidanceSettings, OptimizeSettings):
    """One insertion. Checked for ranges and finiteness when made; files are checked later.

    Raises:
        InputError: A value is out of range, or two values exclude each other
            (`ExitCode.USAGE`; further problems are in ``also``).
    """

    photo: str | None = None
    """The photograph: JPEG, PNG, TIFF, WebP, EXR or Radiance HDR"""
    asset: str | None = None
    """The object: .glb, .gltf, .obj, .ply or .stl"""
    out: str | None = None
    """Folder for everything that is written"""
    overwrite: bool = False
    """Replace results that are already in --out"""
    materials: str | None = None
    """materials.json of a run with --refine: factors for the materials of --asset"""
    demo: bool = False
    """Use the scene that ships with warpir in place of --photo and --asset"""

    camera: str | None = None
    """Camera of the photo: warpir's JSON, .fspy or fSpy's JSON (default: the photo's EXIF)"""
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

    place: tuple[float, float, float] | None = None
    """Where the object stands, world coordinates [m]; moved onto the ground along its normal"""
    at: tuple[float, float] | None = None
    """Where the object stands, as a pixel of the ground in the upright photo [px]"""
    rotate_y: float = 0.0
    """Turn of the object about the ground's normal, counter-clockwise seen from above [deg]"""
    scale: float | None = None
    """Factor on the asset's own size [1]"""
    size: float | None = None
    """Longest side of the asset's bounding box after scaling [m]"""

    light: str | None = None
    """The light: a panorama (.hdr, .exr) or lobes (.json)"""
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
    reinhard (x / (1 + x), paler, nothing clips) (default: linear, with --guidance reinhard)"""
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

    alpha: str = "refuse"
    """What to do with a photo that has transparency: refuse or ignore"""
    max_pixels: int = 64_000_000
    """Largest photo that is opened [px]"""
    missing_textures: str = "error"
    """What to do when a texture of the asset is missing: error, or grey in its place"""
    mark: bool = True
    """Note in the picture's metadata that it is a composite"""

    guidance: str = "none"
    """What recovers the light from the photo: stable-diffusion; or none, and the light is used as
    given"""
    prompt: str | None = None
    """What the object is, in a few words, such as 'a black SUV car'"""
    show_prior: tuple[str, ...] | None = None
    """Prompts, separated by |, for pictures of what the model imagines, before and after it was
    adapted to the photo"""
    preview_every: int = 0
    """Steps between two preview pictures of the optimisation; 0: none"""
    checkpoint_every: int = 50
    """Steps between two checkpoints of the optimisation; 0: none"""
    resume: bool = False
    """Go on from the last checkpoint in --out"""

    reuse: str | None = None
    """Folder of an earlier run: its light and its tone curves are used, and nothing is optimised"""
    sequence: str | None = None
    """JSON lines, each a frame: what differs from the command line, such as {"photo": "2.png",
    "place": [0, 0, -4]}; needs --reuse"""
    refine: str | None = None
    """What is changed by the prompt under a known light (--reuse, --light, --sun or --sky):
    material, emission or tone"""
    refine_parts: tuple[str, ...] | None = None
    """What --refine material changes: base-color, metallic, roughness (default: all of them)"""
    refine_materials: tuple[str, ...] | None = None
    """Names of the asset's materials that --refine changes (default: all of them)"""

    def __post_init__(self) -> None:
        """Check everything that can be checked without opening a file."""
        raise_all([*_values_out_of_range(self), *_values_that_clash(self)])

    @property
    def tone_operator(self) -> str:
        """`tone`, or what stands for it: recovered curves want an operator that never clips."""
        return self.tone or ("linear" if self.guidance == "none" else "reinhard")

    @property
    def step_count(self) -> int:
        """`steps`, or what stands for it: a few unknowns under a known light need fewer."""
        if self.steps is None and self.refine is not None:
            return REFINE_STEPS[self.refine]
        return super().step_count

    def require_inputs(self) -> None:
        """Check that what every run needs is named.

        Kept apart from construction so that a notebook can build a configuration in steps.

        Raises:
            InputError: A needed value is absent (`ExitCode.USAGE`).
        """
        # The lines of a sequence may name photos and assets; each frame is checked by itself.
        needed = {} if self.demo or self.sequence else dict.fromkeys(("photo", "asset"), DEMO_HINT)
        needed["out"] = ""
        if self.guidance == "stable-diffusion":
            needed["model"] = "--guidance stable-diffusion needs a folder or a hub id"
        if self.guidance != "none" or self.refine is not None:
            needed["prompt"] = "say in a few words what the object is"
        raise_all(
            [
                usage(flag(name), "needed", advice)
                for name, advice in needed.items()
                if getattr(self, name) is None
            ]
        )


def flag(name: str) -> str:
    """Return a field's spelling at the command line; what is on by default is switched off."""
    return ("--no-" if DEFAULTS[name] is True else "--") + name.replace("_", "-")


def usage(where: str, what: str, advice: str = "") -> InputError:
    """Make the error of a wrong command line or configuration."""
    return InputError(where, what, advice, ExitCode.USAGE)


RANGES: dict[str, tuple[float, float | None]] = {
    "pitch": (-90, 90),
    "fit_lobes": (1, 4096),
    "exposure": (-30, 30),
    "samples": (1, 2**20),
    "rays": (1, 2**10),
    "depth": (1, 2**10),
    "indirect_limit": (0, None),
    "width": (8, 65_536),
    "threads": (1, 2**10),
    "seed": (0, SEED_LIMIT - 1),
    "max_pixels": (1, None),
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

ABOVE_ZERO = ("camera_height", "scale", "size", "ground_albedo", "lora_rate", "chroma_limit")

CHOICES = {
    "up": ("x", "+x", "-x", "y", "+y", "-y", "z", "+z", "-z"),
    "tone": ("reinhard", "linear"),
    "alpha": ("refuse", "ignore"),
    "missing_textures": ("error", "grey"),
    "guidance": ("none", "stable-diffusion"),
    "precision": ("fp16", "bf16", "fp32"),
    "vae_precision": ("fp16", "bf16", "fp32"),
    "loss": (
        "lds",
        "sds",
        "sds-base",
        "csd",
        "lds-lora-both",
        "lds-negative",
        "dataset-update",
    ),
    "weight": ("sigma2", "sigma", "uniform"),
    "fusion": ("schedule", "single", "none"),
    "integrator": ("transport", "mis"),
    "refine": ("material", "emission", "tone"),
}
LOSSES_OF_BASE = ("csd", "sds-base", "dataset-update")
"""Losses that do without an adapter."""
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


def _values_out_of_range(config: InsertConfig) -> Iterator[InputError]:
    def check(name: str, accepted: bool, expected: str) -> Iterator[InputError]:
        value = getattr(config, name)
        # A NaN fails every comparison and is reported as not finite.
        if value is not None and value == value and not accepted:
            yield usage(flag(name), f"{expected} (found {_shown(value)})")

    values = {field.name: getattr(config, field.name) for field in fields(config)}
    for name, value in values.items():
        yield from _not_plain(name, value)
    yield from check("fov", config.fov is None or 0.0 < config.fov < 180.0, "between 0 and 180")
    in_order = config.fusion_end >= config.fusion_start
    yield from check("fusion_end", in_order, "at least --fusion-start")
    yield from check("ground_albedo", config.ground_albedo <= 1.0, "at most 1")
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


def _not_plain(name: str, value: object) -> Iterator[InputError]:
    """Find numbers that are not finite and texts that no file or model can be asked for."""
    parts = value if isinstance(value, tuple) else (value,)
    if any(isinstance(part, float) and not math.isfinite(part) for part in parts):
        yield usage(flag(name), f"finite numbers (found {_shown(value)})")
    texts = [part for part in parts if isinstance(part, str)]
    if not parts or any("\0" in t or not (t or name in EMPTY_ALLOWED) for t in texts):
        yield usage(flag(name), "a text that is not empty and holds no NUL")
    longest = max((len(text.encode("utf-8", "replace")) for text in texts), default=0)
    if name in PROMPTS and longest > PROMPT_BYTES_LIMIT:
        yield usage(
            flag(name), f"a text too long (found {longest} bytes; expected {PROMPT_BYTES_LIMIT})"
        )


EXCLUSIVE = (
    ("demo", "photo"),
    ("demo", "asset"),
    ("demo", "camera"),
    ("camera", "fov"),
    ("camera", "pitch"),
    ("camera", "horizon"),
    ("camera", "camera_height"),
    ("pitch", "horizon"),
    ("place", "at"),
    ("scale", "size"),
    ("light", "sun"),
    ("light", "sky"),
    ("reuse", "demo"),
    ("reuse", "light"),
    ("reuse", "sun"),
    ("reuse", "sky"),
    ("sequence", "refine"),
    ("resume", "overwrite"),
    ("lora", "personalize"),
)
"""Pairs of fields of which at most one may be given."""


def _values_that_clash(config: InsertConfig) -> Iterator[InputError]:
    def given(name: str) -> bool:
        return bool(getattr(config, name) != DEFAULTS[name])

    def needs(name: str, fulfilled: bool, what: str) -> Iterator[InputError]:
        if given(name) and not fulfilled:
            yield usage(flag(name), f"needs {what}")

    for first, second in EXCLUSIVE:
        if given(first) and given(second):
            yield usage(flag(second), f"cannot be used with {flag(first)}", "leave one of them out")
    guided = given("guidance")
    if given("reuse") and guided and not given("refine"):
        yield usage(
            "--guidance",
            "cannot be used with --reuse, whose light is known",
            "leave one of them out, or say with --refine what is to change under that light",
        )
    yield from needs("fit_lobes", given("light"), "--light with a panorama to fit")
    yield from needs("up", given("camera"), "--camera; without a camera file the world is Y up")
    yield from needs("sequence", given("reuse"), "--reuse: one light for all frames")
    yield from needs("show_prior", guided, "--guidance and its --model")
    if given("show_prior") and guided and not config.personalize:
        yield usage("--no-personalize", "cannot be used with --show-prior, which shows its effect")
    yield from needs("resume", guided, "--guidance: nothing else has checkpoints")
    lit = any(map(given, ("reuse", "light", "sun", "sky", "demo")))
    level = "--light, --sun or --sky: with --guidance alone the light's level is recovered"
    yield from needs("exposure", lit or not guided, level)
    yield from needs("refine", lit, "a known light: --reuse, --light, --sun or --sky")
    yield from needs("refine", guided, "--guidance, which judges the change")
    yield from needs("refine_parts", config.refine == "material", "--refine material")
    with_materials = config.refine in ("material", "emission")
    yield from needs("refine_materials", with_materials, "--refine material or emission")
    if config.refine == "tone" and not config.tone_curve:
        yield usage(
            "--no-tone-curve", "cannot be used with --refine tone, which changes nothing else"
        )
    if guided and not config.personalize and config.loss not in LOSSES_OF_BASE:
        yield usage(
            "--no-personalize",
            f"cannot be used with --loss {config.loss}, which compares the adapted model",
            f"add --loss {' or '.join(LOSSES_OF_BASE)}, or leave it out",
        )
    if config.loss == "lds-negative" and not config.negative_prompt:
        yield usage("--loss", "lds-negative needs --negative-prompt, which it moves away from")
    for low, high in (("time_min", "time_max"), ("crop_min", "crop_max")):
        least, greatest = getattr(config, low), getattr(config, high)
        if least > greatest:
            yield usage(flag(low), f"at most {flag(high)} (found {least:g} and {greatest:g})")


def _shown(value: object) -> str:
    if isinstance(value, tuple):
        value = ",".join(part if isinstance(part, str) else f"{part:g}" for part in value)
    text = str(value)
    return text if len(text) <= 60 else text[:57] + "..."


DEFAULTS = {field.name: field.default for field in fields(InsertConfig)}
"""What a field holds when nobody names it."""
