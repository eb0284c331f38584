"""What one insertion is asked to do: `InsertConfig`, plain values only.

Each field is one flag of the command line (``camera_height`` is ``--camera-height``), one key of a
configuration file and one entry under ``config`` in ``run.json``. The line below a field is its
``--help``. Angles are degrees here and at the command line, radians everywhere inside.
"""

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, fields

from warpir.errors import ExitCode, InputError, raise_all

SKY_PRESETS = ("clear", "overcast", "sunset")
UP_AXES = ("x", "+x", "-x", "y", "+y", "-y", "z", "+z", "-z")
SEED_LIMIT = 2**32
"""Seeds are the 32-bit words that the kernels hash."""
WIDTH_LIMIT = 65_536
DEVICE_FORM = re.compile(r"cpu|cuda(:\d+)?")


@dataclass(frozen=True)
class InsertConfig:
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

    tone: str = "linear"
    """How the object's radiance becomes display values: linear (clipped, as the photo was), or
    reinhard (x / (1 + x), paler, nothing clips)"""
    ground_albedo: float = 0.25
    """Reflectance assumed of the ground, for the automatic exposure [1]"""

    guidance: str = "none"
    """What recovers the light from the photo; none: the light is used as given"""
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
    """Note in the picture's metadata that it is a composite; --no-mark leaves that out"""

    def __post_init__(self) -> None:
        """Check everything that can be checked without opening a file."""
        raise_all([*_values_out_of_range(self), *_values_that_clash(self)])

    def require_inputs(self) -> None:
        """Check that the files every run needs are named.

        Kept apart from construction so that a notebook can build a configuration in steps.

        Raises:
            InputError: A needed value is absent (`ExitCode.USAGE`).
        """
        problems = []
        for name in ("out",) if self.demo else ("photo", "asset", "out"):
            if getattr(self, name) is None:
                advice = "" if name == "out" else "--demo needs neither --photo nor --asset"
                problems.append(usage(flag(name), "needed", advice))
        raise_all(problems)


def flag(name: str) -> str:
    """Return a field's spelling at the command line."""
    return "--no-mark" if name == "mark" else "--" + name.replace("_", "-")


def usage(where: str, what: str, advice: str = "") -> InputError:
    """Make the error of a wrong command line or configuration."""
    return InputError(where, what, advice, ExitCode.USAGE)


def _values_out_of_range(config: InsertConfig) -> Iterator[InputError]:
    for field in fields(config):
        value = getattr(config, field.name)
        numbers = value if isinstance(value, tuple) else (value,)
        if any(isinstance(number, float) and not math.isfinite(number) for number in numbers):
            yield usage(flag(field.name), f"finite numbers (found {_shown(value)})")
        if isinstance(value, str) and (not value or "\0" in value):
            yield usage(flag(field.name), "a text that is not empty and holds no NUL")

    def check(name: str, accepted: bool, expected: str) -> Iterator[InputError]:
        value = getattr(config, name)
        # A NaN fails every comparison and was reported above.
        if value is not None and value == value and not accepted:
            yield usage(flag(name), f"{expected} (found {_shown(value)})")

    def at_least(name: str, low: float, high: float | None = None) -> Iterator[InputError]:
        value = getattr(config, name)
        yield from check(name, value is None or value >= low, f"at least {low}")
        if high is not None:
            yield from check(name, value is None or value <= high, f"at most {high}")

    def above_zero(name: str) -> Iterator[InputError]:
        value = getattr(config, name)
        yield from check(name, value is None or value > 0.0, "more than 0")

    def one_of(name: str, names: tuple[str, ...]) -> Iterator[InputError]:
        yield from check(name, getattr(config, name) in names, " or ".join(names))

    yield from check("fov", config.fov is None or 0.0 < config.fov < 180.0, "between 0 and 180")
    yield from at_least("pitch", -90, 90)
    yield from above_zero("camera_height")
    yield from one_of("up", UP_AXES)
    if config.ground is not None and all(map(math.isfinite, config.ground)):
        yield from check("ground", any(config.ground[:3]), "a normal a,b,c that is not 0")
    yield from above_zero("scale")
    yield from above_zero("size")
    yield from at_least("fit_lobes", 1, 4096)
    if config.sun is not None:
        yield from check("sun", -90.0 <= config.sun[1] <= 90.0, "elevation -90 to 90")
        yield from check("sun", len(config.sun) < 3 or config.sun[-1] >= 0.0, "strength at least 0")
    if isinstance(config.sky, tuple):
        yield from check("sky", min(config.sky) >= 0.0, "radiance at least 0")
    else:
        presets = f"{', '.join(SKY_PRESETS)} or R,G,B"
        yield from check("sky", config.sky in SKY_PRESETS, presets)
    yield from at_least("exposure", -30, 30)
    yield from one_of("tone", ("reinhard", "linear"))
    yield from check("ground_albedo", 0.0 < config.ground_albedo <= 1.0, "more than 0, at most 1")
    yield from one_of("guidance", ("none",))
    yield from at_least("samples", 1, 2**20)
    yield from at_least("rays", 1, 2**10)
    yield from at_least("depth", 1, 2**10)
    yield from at_least("indirect_limit", 0)
    yield from at_least("width", 8, WIDTH_LIMIT)
    if config.device is not None:
        known = DEVICE_FORM.fullmatch(config.device) is not None
        yield from check("device", known, "cpu, cuda or cuda:N")
    yield from at_least("threads", 1, 2**10)
    yield from at_least("seed", 0, SEED_LIMIT - 1)
    yield from one_of("alpha", ("refuse", "ignore"))
    yield from at_least("max_pixels", 1)
    yield from one_of("missing_textures", ("error", "grey"))


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
)
"""Pairs of fields of which at most one may be given."""


def _values_that_clash(config: InsertConfig) -> Iterator[InputError]:
    def given(name: str) -> bool:
        return getattr(config, name) not in (None, False)

    for first, second in EXCLUSIVE:
        if given(first) and given(second):
            yield usage(flag(second), f"cannot be used with {flag(first)}", "leave one of them out")
    if given("fit_lobes") and not given("light"):
        yield usage("--fit-lobes", "needs --light with a panorama to fit")
    if given("up") and not given("camera"):
        yield usage("--up", "needs --camera; without a camera file the world is Y up")


def _shown(value: object) -> str:
    text = ",".join(f"{v:g}" for v in value) if isinstance(value, tuple) else str(value)
    return text if len(text) <= 60 else text[:57] + "..."
