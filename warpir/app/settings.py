"""The parts of a configuration: what each stage of an insertion is asked to do; plain values only.

Each field is one flag of the command line (``height`` of `CameraConfig` is ``--camera-height``),
one key of a configuration file and one entry under ``config`` in ``run.json``. Its range and form
stand on it (`warpir.core.options`), and its help below it. Angles are degrees here and at the
command line, radians everywhere inside. Defaults are the authors' (DiPIR, Liang et al. 2024) where
they state one, else ours. What is None is open: it follows from other values.
"""

from dataclasses import dataclass
from pathlib import Path

from warpir.core.options import option
from warpir.diffusion.settings import GuidanceSettings

AXES = ("x", "+x", "-x", "y", "+y", "-y", "z", "+z", "-z")


AUTO = ("auto", "off")
"""Words that may stand in place of a number that can be estimated from the photo."""


@dataclass(frozen=True)
class InputConfig:
    """The photograph, the object, and how strictly their files are read."""

    photo: str | None = option(None, "FILE")
    """The photograph; JPEG, PNG, TIFF, WebP, EXR or Radiance HDR"""
    layer: str | None = option(None, "NAME")
    """Layer of an EXR photo (default: its R, G and B); such as beauty for beauty.R, beauty.G and
    beauty.B"""
    occluder_mask: str | None = option(None, "FILE")
    """Grey image, white where the photo stays in front of the object; of the upright photo's
    size"""
    asset: str | None = option(None, "FILE")
    """The object: .glb, .gltf, .obj, .ply or .stl"""
    asset_up: str | None = option(None, "AXIS", choices=AXES)
    """Axis of the asset that points up (default: +y); as glTF demands; other tools' OBJ, PLY and
    STL are often +z"""
    materials: str | None = option(None, "FILE")
    """materials.json of a run with --refine; factors for the materials of --asset"""
    demo: bool | str = option(False, "[wet]", choices=("wet",))
    """Use the scene that ships with warpir; in place of --photo and --asset; wet: after rain"""
    alpha: str = option("refuse", "RULE", expert=True, choices=("refuse", "ignore"))
    """What to do with a photo that has transparency: refuse or ignore"""
    strict: bool = option(False)
    """Refuse values that are not finite in place of repairing them; in a photo or a panorama, and
    negative light"""
    missing_textures: str = option("error", "RULE", expert=True, choices=("error", "grey"))
    """What to do when a texture of the asset is missing: error, or grey in its place"""


@dataclass(frozen=True)
class CameraConfig:
    """The camera of the photo and the ground that it sees."""

    file: str | None = option(None, "FILE|DIR", name="camera")
    """Camera of the photo (default: the photo's EXIF); warpir's JSON, .fspy or fSpy's JSON, a
    COLMAP model's folder, the transforms.json of nerfstudio, Waymo's calibration, glTF or EXR"""
    frame: str | None = option(None, "NAME")
    """Image or camera of --camera (default: named as the photo)"""
    undistort: bool = option(False)
    """Undo the lens distortion that the camera file states; the composite is of the straight
    photo"""
    fov: float | None = option(None, "DEG", above=0, below=180)
    """Horizontal field of view of the photo [deg]"""
    pitch: float | None = option(None, "DEG", low=-90, high=90)
    """How far the camera looks up, negative for down [deg]"""
    roll: float | None = option(None, "DEG", low=-90, high=90)
    """Turn of the camera about its axis [deg]; counter-clockwise as seen from behind it: a level
    horizon falls to the right in the photo"""
    horizon: float | None = option(None, "ROW")
    """Row of the horizon [px], or its share of the height; in the photo's middle column, from the
    top; a share when between 0 and 1; in place of --pitch"""
    height: float | None = option(None, "M", name="camera_height", low=1e-6, high=1e9)
    """Height of the camera above the ground [m]"""
    source: str = option("estimate", "SOURCE", name="camera_from", choices=("estimate", "assume"))
    """Numbers not given: estimate or assume; from the photo, or level and 60 degrees wide"""
    up: str | None = option(None, "AXIS", expert=True, choices=AXES)
    """Which axis of the camera file's world points up"""
    ground: tuple[float, float, float, float] | None = option(None, "A,B,C,D")
    """Ground plane a x + b y + c z + d = 0 (default: y = 0); in world coordinates [1, 1, 1, m]"""
    ground_points: str | None = option(None, "FILE|DIR")
    """Points of the scene, to which the ground is fitted; in the camera file's world (.ply, text,
    COLMAP model); without --at and --place the object stands where it is free"""
    proxy: str | None = option(None, "FILE")
    """Mesh of the place: receives shadows, hides the object; in world coordinates [m], +Y up: .glb,
    .gltf, .obj, .ply or .stl; beside the ground plane, and it stands in the light's way"""
    plane: bool = option(True)
    """The ground plane beside the mesh of --proxy"""
    shadow_mask: str | None = option(None, "FILE")
    """Grey image, white where the ground is in shadow already; of the photo's size; the sun and
    other lamps are not taken away there once more"""


@dataclass(frozen=True)
class PlacementConfig:
    """Where the object stands, and how large it is."""

    place: tuple[float, float, float] | None = option(None, "X,Y,Z")
    """Where the object stands, world coordinates [m]; moved onto the ground along its normal (not
    with --no-plane)"""
    at: tuple[float, float] | None = option(None, "U,V")
    """Where the object stands, as a pixel of the photo [px]; of the ground or of --proxy in the
    upright photo"""
    rotate_y: float = option(0.0, "DEG")
    """Turn of the object, counter-clockwise from above [deg]; about the ground's normal"""
    scale: float | None = option(None, "S", low=1e-9, high=1e9)
    """Factor on the asset's own size [1]"""
    size: float | None = option(None, "METRES", low=1e-6, high=1e9)
    """Longest side of the asset after scaling [m]; of its bounding box"""
    settle: bool = option(True, expert=True)
    """Closing of gaps of up to 5 mm or 1 % of its size below the object; if sunk by as much, it is
    raised"""
    sink: float = option(0.0, "METRES", expert=True, low=0, high=1e9)
    """How deep the object sinks into soft ground [m]; grass, sand, snow"""


@dataclass(frozen=True)
class LightConfig:
    """The light as it is given, and how radiance becomes display values."""

    file: str | None = option(None, "FILE", name="light")
    """The light: a panorama (.hdr, .exr, picture) or lobes (.json); a picture lacks a sun's
    strength"""
    convention: str = option(
        "openexr",
        "NAME",
        name="light_convention",
        choices=("openexr", "nvdiffrec", "threejs", "blender", "diffusionlight"),
    )
    """Who made the panorama: tells where its seam lies; openexr (also OpenUSD and Mitsuba),
    nvdiffrec, threejs, blender, or diffusionlight, whose maps turn with the camera"""
    rotate: float = option(0.0, "DEG", name="light_rotate")
    """Turn of the light, counter-clockwise from above [deg]; about +Y"""
    fit_lobes: int | None = option(None, "N", low=1, high=4096)
    """Replace the panorama by this many fitted lobes; spherical Gaussians"""
    sun: tuple[float, float] | tuple[float, float, float] | None = option(
        None, "AZIM,ELEV[,STRENGTH]"
    )
    """A sun: azimuth, elevation [deg], strength; azimuth clockwise from -Z seen from above; the
    strength is the irradiance it gives a surface that faces it, relative [W/m^2]"""
    sky: str | tuple[float, float, float] | None = option(None, "NAME|R,G,B")
    """A sky: clear, overcast, sunset, or its radiance; linear R,G,B, relative [W/(m^2 sr)]"""
    reuse: str | None = option(None, "DIR")
    """Earlier run whose light and tone curves are used; nothing is optimised"""
    start: str | None = option(None, "NAME", choices=("regressed", "uniform"))
    """Start without a light: regressed (default) or uniform; where the recovery begins when no
    light is given: as the regressor sees it in the photo, or an even light"""
    regressor: str | None = option(None, "FILE")
    """Weights of the regressor (default: those in the package)"""
    visible_sun: bool = option(True)
    """Take the direction of a sun that the photo shows; it overrules the regressor's, and the sun
    is as strong as suns in view are"""
    exposure: float | None = option(None, "EV", low=-30, high=30)
    """Factor on the light, in stops (default: from the photo); [EV]"""
    tone: str | None = option(None, "NAME", choices=("reinhard", "linear"))
    """Object's radiance to display values: linear or reinhard; clipped, as the photo was, or x / (1
    + x), which is paler and does not clip (default: reinhard where a model guides, else linear)"""
    ground_albedo: float | None = option(None, "SHARE", low=1e-6, high=1)
    """Reflectance of the ground, for the exposure; which is automatic without --exposure: 0.25
    where a light is given; one that is estimated from the photo follows the ground only where this
    is stated"""
    lamp: (
        tuple[float, float, float, float, float]
        | tuple[float, float, float, float, float, float, float, float]
        | None
    ) = option(None, "X,Y,Z,RADIUS,POWER[,R,G,B]", expert=True)
    """A lamp near the object, a sphere; place and radius in world coordinates [m]; white that faces
    it at a distance d shows POWER / (4 pi^2 d^2) of the photo's white; R,G,B are linear factors"""
    lamps: str | None = option(None, "FILE", expert=True)
    """Lamps near the object: spheres and rectangles (.json), or the point lights of a glTF file; in
    world coordinates"""
    detail: bool = option(True)
    """Let the object reflect what the photo shows around it; where the light has no panorama's
    detail of its own"""

    @property
    def is_described(self) -> bool:
        """Whether the user stated anything about the light."""
        return any(value is not None for value in (self.file, self.sun, self.sky))

    @property
    def has_lamps(self) -> bool:
        """Whether there are lamps near the object."""
        return self.lamp is not None or self.lamps is not None

    @property
    def assumed_albedo(self) -> float:
        """Reflectance of the ground under a light that is given [1]."""
        return 0.25 if self.ground_albedo is None else self.ground_albedo


SAMPLED_PIXELS = 3_000_000
"""Pixels above which a picture has fewer samples in each: seen whole, it has the same noise."""


@dataclass(frozen=True)
class RenderConfig:
    """How the picture is rendered, and on what."""

    samples: int | None = option(None, "N", low=1, high=2**20)
    """Samples per pixel (default: 32, above 3 megapixels fewer, down to 16); from 32 on a mean, on
    the CPU more where noise is; there a small object has by default up to four times as many, if
    their noise would be seen"""
    rays: int = option(1, "N", low=1, high=2**10)
    """Rays per sample, of light and of surface each"""
    depth: int = option(5, "D", low=1, high=2**10)
    """Longest light path, in surface hits"""
    indirect_limit: float = option(4.0, "RADIANCE", low=0)
    """Most radiance of each bounce but the first (0: any); that is in a pixel of --samples, more in
    one that gets more; the limit, a quarter or less for what is thrown onto the ground and
    more on a linear plate of white above 1, removes specks where a mirror throws sunlight"""
    bounce: bool = option(True, expert=True)
    """Let the object throw light on the ground; what it reflects and emits there is in the shadow
    ratio, which --no-bounce leaves to what the object blocks, as DiPIR does"""
    ground_roughness: float | str = option(
        "off", "auto|off|R", expert=True, choices=("auto", "off"), low=0, high=1
    )
    """Let the ground mirror the object, as wet asphalt, tiles and lacquer do; its roughness, 0 is a
    mirror; auto: estimated where the photo shows mirror images on the ground, else off; for a plane
    as ground, in the picture and its first preview; guidance does without it"""
    denoise: str = option("auto", "auto|off", expert=True, choices=("auto", "off"))
    """Take the renderer's noise out of object and shadow; auto: where pyoidn is installed (pip
    install warpir[denoise])"""
    width: int | None = option(None, "W", low=8, high=65_536)
    """Width at which the object is rendered (default: the photo's); [px]"""
    device: str | None = option(None, "NAME")
    """cpu, cuda or cuda:N (default: cuda where there is one); else cpu"""
    threads: int | None = option(None, "N", low=1, high=2**10)
    """CPU threads (default: one per core)"""
    seed: int = option(0, "N", low=0, high=2**32 - 1)
    """Seed of all random numbers"""
    deterministic: bool = option(False)
    """Repeat the same bytes on a GPU too, slower; on the CPU every run does"""

    def samples_at(self, width: int, height: int) -> int:
        """Return the samples of each pixel of a picture of this size [px]."""
        if self.samples is not None:
            return self.samples
        return min(32, max(16, round(32 * SAMPLED_PIXELS / (width * height))))

    @property
    def bounce_depth(self) -> int:
        """Surface hits of light that the object throws on the ground; 0 without a bounce."""
        return self.depth if self.bounce else 0

    @property
    def coat_roughness(self) -> float | None:
        """Roughness of a ground that mirrors the object [1]; None: it is matt, or not known yet."""
        return None if isinstance(self.ground_roughness, str) else self.ground_roughness


@dataclass(frozen=True)
class LookConfig:
    """What the photo's camera did to the scene, and is done to the object."""

    sharpness: float | str = option("auto", "auto|off|PX", choices=AUTO, low=0, high=32)
    """Blur of the object [px]; auto: that of the photo, by edges and texture around it; a value is
    the standard deviation"""
    response: float | str = option(
        "auto", "auto|off|EXPONENT", expert=True, choices=AUTO, low=0.25, high=4
    )
    """Contrast of the object's dark and bright tones; auto: as the photo's values suggest, where no
    tone curve was recovered; a value is the slope at mid grey over that of gamma 2.2"""
    grain: float | str = option("auto", "auto|off|CODES", choices=AUTO, low=0, high=64)
    """Noise on object and shadow; auto: the photo's, by its flat patches and its texture; a value
    is the standard deviation in codes of 255"""


@dataclass(frozen=True)
class GuidanceConfig(GuidanceSettings):
    """Which prior guides, and what it is asked."""

    kind: str | None = option(None, "NAME", name="guidance", choices=("stable-diffusion", "none"))
    """Prior: stable-diffusion or none; what changes the light so that the picture looks right. With
    none the light is used as given, or else as it is estimated from the photo (default:
    stable-diffusion with --model)"""
    prompt: str | None = option(None, "TEXT", is_prompt=True)
    """What the object is, such as 'a black SUV car'; in a few words; stable-diffusion needs it"""
    accept: bool = option(False)
    """Keep the start of the recovery unless its end is better; guidance, asked anew, must clearly
    prefer the end"""
    show_prior: tuple[str, ...] | None = option(None, "TEXT|TEXT", is_prompt=True, separator="|")
    """Prompts for pictures of what the model imagines; separated by |; before and after it was
    adapted to the photo"""


@dataclass(frozen=True)
class OptimizeSettings:
    """How light and tone curves are recovered from the guidance's gradient."""

    preview_every: int = option(50, "N", low=0, high=10**6)
    """Steps between two preview pictures (0: none); of the optimisation, the first of which is the
    start"""
    checkpoint_every: int = option(50, "N", expert=True, low=0, high=10**6)
    """Steps between two checkpoints of the optimisation; 0: none"""
    steps: int | None = option(None, "N", low=0, high=10**6)
    """Steps of the optimisation (default: 600); with --refine 300, or 200 for tone"""
    guidance_width: int = option(384, "W", expert=True, low=8, high=4096)
    """Width of the picture inside the loop [px]; its height follows the photo's shape"""
    lobes: int = option(64, "N", expert=True, low=1, high=4096)
    """Spherical-Gaussian lobes of each light, the object's and the shadow's, where an even or a
    given light starts; the estimate has 15 of its own"""
    lobe_width: float = option(0.6, "SPACINGS", expert=True, low=0.05, high=10)
    """Width of the lobes at the start of an even light, sigma in spacings of the lobes"""
    light_height: int = option(64, "ROWS", expert=True, low=4, high=512)
    """Rows of the maps in which the two lights are fused"""
    object_light_height: int = option(32, "ROWS", expert=True, low=4, high=512)
    """Rows of the map that lights the object while its light transport is stored"""
    fusion: str = option("schedule", "NAME", expert=True, choices=("schedule", "single", "none"))
    """How the two lights become one: schedule (blended from none to all over the run), single (one
    light from the start) or none (two lights to the end)"""
    fusion_start: float = option(0.0, "SHARE", expert=True, low=0, high=1)
    """Where in the run the lights begin to become one, as a share of the steps"""
    fusion_end: float = option(1.0, "SHARE", expert=True, low=0, high=1)
    """Where in the run they are one, as a share of the steps"""
    lobe_shape: bool = option(True, expert=True)
    """Recover widths and colours of the lobes too, not their directions and strengths alone"""
    recover_lamps: bool = option(False, expert=True)
    """Recover powers and colours of --lamp and --lamps too, beside the light from afar"""
    tone_curve: bool = option(True, expert=True)
    """Recover tone curves for the object and its shadow"""
    integrator: str = option("transport", "NAME", expert=True, choices=("transport", "mis"))
    """What renders inside the loop: transport (light transport is traced once and then reused) or
    mis (every step is traced)"""
    transport_memory: int = option(4096, "MIB", expert=True, low=1, high=2**24)
    """Most memory that the stored light transport may take [MiB]"""
    mis_samples: int = option(16, "N", expert=True, low=1, high=2**20)
    """Samples per pixel of --integrator mis"""
    retrace_at: float = option(3.0, "FACTOR", expert=True, low=1)
    """Light transport is traced again when the lights have changed so much that its noise has grown
    by this factor"""
    rate: float = option(1.0, "FACTOR", expert=True, low=0, high=10)
    """Factor on all learning rates"""
    rate_end: float = option(0.1, "FACTOR", expert=True, low=0, high=1)
    """Factor to which all learning rates fall over the second half of the run, by a cosine"""
    rate_intensity: float = option(0.12, "R", expert=True, low=0, high=10)
    """Learning rate of the lobes' log intensities"""
    rate_axis: float = option(0.04, "R", expert=True, low=0, high=10)
    """Learning rate of the lobes' directions; 0.04 is at most two degrees per step"""
    rate_width: float = option(0.06, "R", expert=True, low=0, high=10)
    """Learning rate of the lobes' log widths"""
    rate_chroma: float = option(0.01, "R", expert=True, low=0, high=10)
    """Learning rate of the lobes' log colour ratios"""
    rate_tone: float = option(0.01, "R", expert=True, low=0, high=10)
    """Learning rate of the tone curves"""
    rate_material: float = option(0.02, "R", expert=True, low=0, high=10)
    """Learning rate of --refine material"""
    rate_emission: float = option(0.05, "R", expert=True, low=0, high=10)
    """Learning rate of --refine emission, whose factors range over decades"""
    adam_beta1: float = option(0.9, "B", expert=True, low=0, high=0.999999)
    """Adam's decay of the gradient's mean"""
    adam_beta2: float = option(0.99, "B", expert=True, low=0, high=0.999999)
    """Adam's decay of the gradient's square"""
    consistency: float = option(0.03, "W", expert=True, low=0)
    """Weight of the term that gives the object's light the shape of the shadow's (eq. 10)"""
    spread: float = option(0.01, "W", expert=True, low=0)
    """Weight of the Cauchy term that keeps the shadow's light in few directions (eq. 11)"""
    chroma: float = option(0.1, "W", expert=True, low=0)
    """Weight of the prior that keeps the light's colour near white"""
    tone_bins: int = option(5, "N", expert=True, low=1, high=64)
    """Bins of each tone curve"""
    bend: float = option(0.1, "W", expert=True, low=0)
    """Weight of the prior that keeps tone curves near the identity"""
    trust: float = option(4.0, "W", low=0)
    """Weight that holds the light near the regressed one; in squares of what that is uncertain by;
    0: not at all"""
    chroma_limit: float = option(1.5, "LOG", expert=True, above=0, high=20)
    """Greatest log colour ratio of a lobe"""
    intensity_limit: float = option(1e6, "FACTOR", expert=True, low=1, high=1e12)
    """Greatest factor between a lobe's intensity and that of the start, either way"""
    score_every: int = option(25, "N", expert=True, low=0, high=10**6)
    """Steps between two scores, of which the best state is kept; 0: the last state is kept"""

    @property
    def step_count(self) -> int:
        """`steps`, or the authors' number."""
        return 600 if self.steps is None else self.steps


@dataclass(frozen=True)
class TaskConfig:
    """What else is done under a known light."""

    sequence: str | None = option(None, "FILE")
    """JSON lines, each a frame (needs --reuse); what differs from the command line, such as
    {"photo": "2.png", "place": [0, 0, -4]}"""
    fps: float = option(24.0, "N", low=1, high=240)
    """Frames per second of the video of --sequence; which is made where ffmpeg is found"""
    refine: str | None = option(None, "WHAT", choices=("material", "emission", "tone"))
    """Change material, emission or tone under a known light; by the prompt; the light is that of
    --reuse, --light, --sun or --sky"""
    refine_parts: tuple[str, ...] | None = option(None, "NAME,NAME")
    """Parts that --refine material changes (default: all); base-color, metallic, roughness"""
    refine_materials: tuple[str, ...] | None = option(None, "NAMES")
    """Materials that --refine changes, by name (default: all); of the asset"""


@dataclass(frozen=True)
class OutputConfig:
    """Where results are written, and which."""

    out: str | None = option(None, "DIR")
    """Folder for everything that is written"""
    overwrite: bool = option(False)
    """Replace results that are already in --out"""
    resume: bool = option(False)
    """Go on from the last checkpoint in --out"""
    mark: bool = option(True, expert=True)
    """Note in the picture's metadata that it is a composite"""
    hand_off: bool = option(True)
    """Write the files for Blender, three.js, colour tools"""
    report: bool = option(True)
    """Write report.html; a page that shows the result, the light and all figures"""
    mitsuba: bool = option(False)
    """Write a scene of Mitsuba 3 as well; the insertion, into a folder of its own"""
    usd: bool = option(False)
    """Write scene.usdz for OpenUSD as well; object, lights, camera (pip install 'warpir[usd]')"""

    @property
    def folder(self) -> Path:
        """`out` of a configuration that names it, as `InsertConfig.require_inputs` demands."""
        assert self.out is not None
        return Path(self.out)
