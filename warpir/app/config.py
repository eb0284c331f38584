"""What one insertion is asked to do: `InsertConfig`, plain values only.

Each field is one flag of the command line (``camera_height`` is ``--camera-height``), one key of a
configuration file and one entry under ``config`` in ``run.json``. The line below a field is its
``--help``. Angles are degrees here and at the command line, radians everywhere inside.
"""

import math
import os
import re
from collections.abc import Container, Iterator, Mapping
from dataclasses import Field, dataclass, fields
from functools import cache
from numbers import Integral, Real
from os import PathLike
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints

from warpir.app.settings import (
    CameraConfig,
    GuidanceConfig,
    InputConfig,
    LightConfig,
    OptimizeSettings,
    OutputConfig,
    PlacementConfig,
    RenderConfig,
    TaskConfig,
)
from warpir.core.errors import ExitCode, InputError, raise_all
from warpir.core.limits import Limits
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


@dataclass(frozen=True, init=False)
class InsertConfig:
    """One insertion: a part for each stage. Files are checked later.

    It is made by the names of the command line, ``InsertConfig(photo="a.jpg", camera_height=1.6)``;
    each part is an attribute, ``config.camera.height``.

    Raises:
        InputError: A value is out of range, or two values exclude each other
            (`ExitCode.USAGE`; further problems are in ``also``).
        TypeError: A name is unknown.
    """

    inputs: InputConfig
    camera: CameraConfig
    placement: PlacementConfig
    light: LightConfig
    render: RenderConfig
    guidance: GuidanceConfig
    diffusion: ModelSettings
    adapter: PersonalizeSettings
    optimize: OptimizeSettings
    task: TaskConfig
    output: OutputConfig
    limits: Limits

    def __init__(self, **values: Any) -> None:
        """Check everything that can be checked without opening a file."""
        parts: dict[str, dict[str, Any]] = {part.name: {} for part in fields(InsertConfig)}
        for name, value in values.items():
            if name not in OPTIONS:
                raise TypeError(f"InsertConfig has no value {name!r}")
            parts[OPTIONS[name].part][OPTIONS[name].field.name] = _plain(value)
        for name, given in parts.items():
            # Frozen for everybody else.
            object.__setattr__(self, name, PARTS[name](**given))
        raise_all([*_values_out_of_range(self), *_values_that_clash(self)])

    def flat(self) -> dict[str, Any]:
        """Return all values by the names that the command line and ``run.json`` use."""
        return {
            name: getattr(getattr(self, option.part), option.field.name)
            for name, option in OPTIONS.items()
        }

    def changed(self, **values: Any) -> "InsertConfig":
        """Return the same with other values, by the names that `InsertConfig` takes."""
        return InsertConfig(**{**self.flat(), **values})

    @property
    def guided_by(self) -> str:
        """``guidance``, or what stands for it: embedded, stable-diffusion or none."""
        if self.guidance.kind is not None:
            return self.guidance.kind
        if self.diffusion.model is not None:
            return "stable-diffusion"
        is_lit = self.light.reuse is not None or self.is_light_described
        return "none" if is_lit else "embedded"

    @property
    def is_light_described(self) -> bool:
        """Whether the user said anything about the light."""
        return any(v is not None for v in (self.light.file, self.light.sun, self.light.sky))

    @property
    def is_guided(self) -> bool:
        """Whether a prior is asked: the embedded one is where `steps` says how often."""
        return self.guided_by == "stable-diffusion" or (
            self.guided_by == "embedded" and bool(self.optimize.steps)
        )

    @property
    def tone_operator(self) -> str:
        """`tone`, or what stands for it; a light far from its start wants one that never clips."""
        return self.light.tone or PRIOR_DEFAULTS.get(self.guided_by, {"tone": "linear"})["tone"]

    def settled(self, on_cuda: bool = True) -> "InsertConfig":
        """Return the same with nothing left open to the prior; without one, as Stable Diffusion's.

        Args:
            on_cuda: Whether it runs on a CUDA device.
        """
        return self.changed(**_open_values(self, on_cuda))

    def guidance_settings(self) -> GuidanceSettings:
        """Return what guidance is asked to do; nothing may be open (`settled`)."""
        names = (field.name for field in fields(GuidanceSettings))
        return GuidanceSettings(**{name: getattr(self.guidance, name) for name in names})

    def require_inputs(self) -> None:
        """Check that what every run needs is named.

        Kept apart from construction so that a notebook can build a configuration in steps.

        Raises:
            InputError: A needed value is absent (`ExitCode.USAGE`).
        """
        # The lines of a sequence may name photos and assets; each frame is checked by itself.
        is_whole = self.inputs.demo or self.task.sequence
        needed = {} if is_whole else dict.fromkeys(("photo", "asset"), DEMO_HINT)
        needed["out"] = ""
        if self.guided_by == "stable-diffusion":
            needed["model"] = "--guidance stable-diffusion needs a folder or a hub id"
            needed["prompt"] = "say in a few words what the object is"
        values = self.flat()
        missing = {name: advice for name, advice in needed.items() if values[name] is None}
        raise_all([usage(flag(name), "needed", advice) for name, advice in missing.items()])


@dataclass(frozen=True)
class Option:
    """Where one value of a configuration stands."""

    part: str
    """Attribute of `InsertConfig`."""
    field: Field[Any]
    """Field of that part."""


def _options() -> dict[str, Option]:
    found = {}
    for name, part in PARTS.items():
        for field in fields(part):
            own = f"max_{field.name}" if name == "limits" else field.name
            found[field.metadata.get("name", own)] = Option(name, field)
    return found


PARTS: dict[str, Any] = {part.name: part.type for part in fields(InsertConfig)}
"""The parts' classes by their names."""
OPTIONS = _options()
"""Every value by the name that the command line, files and ``run.json`` give it."""
DEFAULTS = {name: option.field.default for name, option in OPTIONS.items()}
"""What a value is when nobody names it."""


def _open_values(config: InsertConfig, on_cuda: bool = True) -> dict[str, Any]:
    """Return what stands for the fields that are open; without a prior, Stable Diffusion's."""
    prior = config.guided_by if config.guided_by in PRIOR_DEFAULTS else "stable-diffusion"
    chosen = PRIOR_DEFAULTS[prior] | ({} if on_cuda else CPU_DEFAULTS[prior])
    if config.task.refine in REFINE_STEPS:
        chosen |= {"steps": REFINE_STEPS[config.task.refine], "accept": False}
    if config.adapter.lora is not None:
        chosen |= {"personalize": True}
    if prior == "embedded" and (config.adapter.lora is not None or config.adapter.personalize):
        chosen |= {"loss": "sds"}  # the same, asked of the adapted model
    if config.guidance.loss == "dataset-update":
        chosen |= {"accept": False}
    if not config.is_guided:
        del chosen["accept"]  # there is no end that could be judged
    values = config.flat()
    # The tone belongs to the light: `InsertConfig.tone_operator`.
    return {k: v for k, v in chosen.items() if k != "tone" and values[k] is None}


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
def kinds() -> dict[str, Any]:
    """Return the annotations of all fields."""
    hints = {name: get_type_hints(part) for name, part in PARTS.items()}
    return {name: hints[option.part][option.field.name] for name, option in OPTIONS.items()}


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
        value = values[name]
        # A NaN fails every comparison and is reported as not finite.
        if value is not None and value == value and not accepted:
            yield usage(flag(name), f"{expected} (found {_shown(value)})")

    values = config.flat()
    of_other_kinds = [name for name, value in values.items() if not _is_a(value, kinds()[name])]
    for name in of_other_kinds:
        expected = str(kinds()[name]).removeprefix("<class '").removesuffix("'>")
        yield usage(flag(name), f"expected {expected} (found {_shown(values[name])})")
    if of_other_kinds:
        return  # from Python alone, and no other check would know what to do with them
    for name, value in values.items():
        yield from _not_plain(name, value, config.limits.prompt_bytes)
    yield from check(
        "fov", config.camera.fov is None or 0.0 < config.camera.fov < 180.0, "between 0 and 180"
    )
    in_order = config.optimize.fusion_end >= config.optimize.fusion_start
    yield from check("fusion_end", in_order, "at least --fusion-start")
    for name in ("place", "ground", "sun", "sky", "at"):
        parts = values[name]
        if isinstance(parts, tuple):
            within = not any(abs(part) > LARGEST for part in parts)
            yield from check(name, within, f"numbers up to {LARGEST:g}")
    if config.camera.ground is not None and all(map(math.isfinite, config.camera.ground)):
        yield from check("ground", any(config.camera.ground[:3]), "a normal a,b,c that is not 0")
    if config.light.sun is not None:
        yield from check("sun", -90.0 <= config.light.sun[1] <= 90.0, "elevation -90 to 90")
        yield from check(
            "sun", len(config.light.sun) < 3 or config.light.sun[-1] >= 0.0, "strength at least 0"
        )
    if isinstance(config.light.sky, tuple):
        yield from check("sky", min(config.light.sky) >= 0.0, "radiance at least 0")
    else:
        presets = f"{', '.join(SKY_PRESETS)} or R,G,B"
        yield from check("sky", config.light.sky in SKY_PRESETS, presets)
    if config.render.device is not None:
        known = DEVICE_FORM.fullmatch(config.render.device) is not None
        yield from check("device", known, "cpu, cuda or cuda:N")
    if config.guidance.prompt and config.adapter.token:
        try:
            make_prompts(config.guidance.prompt, config.adapter)
        except ValueError as error:
            name, _, what = str(error).partition(": ")
            yield usage(flag(name), what)
    if config.task.refine_parts is not None:
        known = set(config.task.refine_parts) <= set(REFINE_PARTS)
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
    values = config.flat()

    def given(name: str) -> bool:
        return bool(values[name] != DEFAULTS[name])

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
    yield from needs("mitsuba", config.output.hand_off, "the files that --no-hand-off leaves out")
    yield from needs("fit_lobes", given("light"), "--light with a panorama to fit")
    yield from needs("light_convention", given("light"), "--light with a panorama")
    yield from needs("up", given("camera"), "--camera; without a camera file the world is Y up")
    for name in ("frame", "undistort", "ground_points"):
        yield from needs(name, given("camera"), "--camera with a camera file")
    yield from needs("sequence", given("reuse"), "--reuse: one light for all frames")
    yield from needs("fps", given("sequence"), "--sequence, of which the video is made")
    yield from needs("show_prior", with_words, "--guidance stable-diffusion and its --model")
    if given("show_prior") and with_words and config.adapter.personalize is False:
        yield usage("--no-personalize", "cannot be used with --show-prior, which shows its effect")
    if given("lora") and config.adapter.personalize is False:
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
    yield from needs("refine_parts", config.task.refine == "material", "--refine material")
    with_materials = config.task.refine in ("material", "emission")
    yield from needs("refine_materials", with_materials, "--refine material or emission")
    if config.task.refine == "tone" and config.optimize.tone_curve is False:
        yield usage(
            "--no-tone-curve", "cannot be used with --refine tone, which changes nothing else"
        )
    yield from _losses_that_clash(config)


def _losses_that_clash(config: InsertConfig) -> Iterator[InputError]:
    """Find what a loss lacks, and ranges that are empty; with what is open as the prior has it."""
    made = {**config.flat(), **_open_values(config)}
    loss = made["loss"]
    if config.guided_by != "none" and not made["personalize"] and loss not in LOSSES_OF_BASE:
        losses = " or ".join(LOSSES_OF_BASE)
        if config.adapter.personalize is False:
            yield usage(
                "--no-personalize",
                f"cannot be used with --loss {loss}, which compares the adapted model",
                f"add --loss {losses}, or leave it out",
            )
        else:
            what = f"{loss} compares the adapted model"
            yield usage("--loss", what, f"add --personalize, or choose {losses}")
    says_itself = config.guided_by == "embedded" or config.guidance.negative_prompt
    if loss in LOSSES_AWAY and not says_itself:
        yield usage("--loss", f"{loss} needs --negative-prompt, which it moves away from")
    if config.guidance.accept and loss == "dataset-update":
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
