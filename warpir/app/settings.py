"""The parts of a configuration: what each stage of an insertion is asked to do; plain values only.

Each field is one flag of the command line (``height`` of `CameraConfig` is ``--camera-height``),
one key of a configuration file and one entry under ``config`` in ``run.json``. The line below a
field is its ``--help``. Angles are degrees here and at the command line, radians everywhere inside.
Defaults are the authors' (DiPIR, Liang et al. 2024) where they state one, else ours. What is None
is open: it follows from other values, or from the prior that guides
(`warpir.app.config.PRIOR_DEFAULTS`).
"""

from dataclasses import dataclass, field

from warpir.diffusion.settings import GuidanceChoices


@dataclass(frozen=True)
class InputConfig:
    """The photograph, the object, and how strictly their files are read."""

    photo: str | None = None
    """The photograph: JPEG, PNG, TIFF, WebP, EXR or Radiance HDR"""
    layer: str | None = None
    """Layer of an EXR photo that is used, such as beauty for beauty.R, beauty.G and beauty.B
    (default: its R, G and B)"""
    occluder_mask: str | None = None
    """Grey image of the upright photo's size: white where the photo stays in front of the object"""
    asset: str | None = None
    """The object: .glb, .gltf, .obj, .ply or .stl"""
    asset_up: str | None = None
    """Which axis of the asset points up (default: +y, as glTF demands; other tools' OBJ, PLY and
    STL are often +z)"""
    materials: str | None = None
    """materials.json of a run with --refine: factors for the materials of --asset"""
    demo: bool = False
    """Use the scene that ships with warpir in place of --photo and --asset"""
    alpha: str = "refuse"
    """What to do with a photo that has transparency: refuse or ignore"""
    strict: bool = False
    """Refuse a photo or panorama with values that are not finite, or a light with negative ones,
    in place of repairing them"""
    missing_textures: str = "error"
    """What to do when a texture of the asset is missing: error, or grey in its place"""


@dataclass(frozen=True)
class CameraConfig:
    """The camera of the photo and the ground that it sees."""

    file: str | None = field(default=None, metadata={"name": "camera"})
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
    height: float | None = field(default=None, metadata={"name": "camera_height"})
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


@dataclass(frozen=True)
class PlacementConfig:
    """Where the object stands, and how large it is."""

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


@dataclass(frozen=True)
class LightConfig:
    """The light as it is given, and how radiance becomes display values."""

    file: str | None = field(default=None, metadata={"name": "light"})
    """The light: a panorama (.hdr, .exr, or a picture without a sun's strength) or lobes (.json)"""
    convention: str = field(default="openexr", metadata={"name": "light_convention"})
    """Who made the panorama, which tells where its seam lies: openexr (also OpenUSD and Mitsuba),
    nvdiffrec, threejs, blender, or diffusionlight, whose maps turn with the camera"""
    rotate: float = field(default=0.0, metadata={"name": "light_rotate"})
    """Turn of the light about +Y, counter-clockwise seen from above [deg]"""
    fit_lobes: int | None = None
    """Replace the panorama by this many spherical-Gaussian lobes fitted to it"""
    sun: tuple[float, float] | tuple[float, float, float] | None = None
    """A sun: azimuth clockwise from -Z seen from above [deg], elevation [deg], irradiance it
    gives a surface that faces it, relative [W/m^2]"""
    sky: str | tuple[float, float, float] | None = None
    """A sky: clear, overcast or sunset, or its linear radiance R,G,B, relative [W/(m^2 sr)]"""
    reuse: str | None = None
    """Folder of an earlier run: its light and its tone curves are used, and nothing is optimised"""
    start: str | None = None
    """Where the recovery begins when no light is given: regressed, as the regressor sees it in the
    photo, or uniform, an even light (default: regressed)"""
    regressor: str | None = None
    """Weights of the regressor (default: those that come with warpir)"""
    exposure: float | None = None
    """Factor on the light, in stops [EV] (default: chosen from the photo)"""
    tone: str | None = None
    """How the object's radiance becomes display values: linear (clipped, as the photo was), or
    reinhard (x / (1 + x), paler, nothing clips)"""
    ground_albedo: float = 0.25
    """Reflectance assumed of the ground, for the automatic exposure [1]"""
    detail: bool = True
    """Let the object reflect what the photo shows of its surroundings, where the light has no
    panorama's detail of its own"""


@dataclass(frozen=True)
class RenderConfig:
    """How the picture is rendered, and on what."""

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


@dataclass(frozen=True)
class GuidanceConfig(GuidanceChoices):
    """Which prior guides, and what it is asked."""

    kind: str | None = field(default=None, metadata={"name": "guidance"})
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
    accept: bool | None = None
    """Keep the start of the recovery unless guidance, asked anew, clearly prefers its end"""
    show_prior: tuple[str, ...] | None = None
    """Prompts, separated by |, for pictures of what the model imagines, before and after it was
    adapted to the photo"""


@dataclass(frozen=True)
class OptimizeSettings:
    """How light and tone curves are recovered from the guidance's gradient."""

    preview_every: int | None = None
    """Steps between two preview pictures of the optimisation, the first of which is the start;
    0: none"""
    checkpoint_every: int = 50
    """Steps between two checkpoints of the optimisation; 0: none"""
    steps: int | None = None
    """Steps of the optimisation; with --refine 300, or 200 for tone; the embedded prior is asked
    with more than 0 alone (experimental: it failed its release gate)"""
    guidance_width: int | None = None
    """Width of the picture inside the loop [px]; its height follows the photo's shape"""
    lobes: int = 64
    """Spherical-Gaussian lobes of each light, the object's and the shadow's"""
    lobe_width: float = 0.6
    """Width of the lobes at the start of an even light, sigma in spacings of the lobes"""
    light_height: int | None = None
    """Rows of the maps in which the two lights are fused"""
    object_light_height: int | None = None
    """Rows of the map that lights the object while its light transport is stored"""
    fusion: str | None = None
    """How the two lights become one: schedule (blended from none to all over the run), single (one
    light from the start) or none (two lights to the end)"""
    fusion_start: float = 0.0
    """Where in the run the lights begin to become one, as a share of the steps"""
    fusion_end: float = 1.0
    """Where in the run they are one, as a share of the steps"""
    lobe_shape: bool | None = None
    """Recover widths and colours of the lobes too, not their directions and strengths alone"""
    tone_curve: bool | None = None
    """Recover tone curves for the object and its shadow"""
    integrator: str = "transport"
    """What renders inside the loop: transport (light transport is traced once and then reused) or
    mis (every step is traced)"""
    transport_memory: int = 4096
    """Most memory that the stored light transport may take [MiB]"""
    mis_samples: int = 16
    """Samples per pixel of --integrator mis"""
    retrace_at: float = 3.0
    """Light transport is traced again when the lights have changed so much that its noise has grown
    by this factor"""
    rate: float | None = None
    """Factor on all learning rates"""
    rate_end: float = 0.1
    """Factor to which all learning rates fall over the second half of the run, by a cosine"""
    rate_intensity: float = 0.12
    """Learning rate of the lobes' log intensities"""
    rate_axis: float = 0.04
    """Learning rate of the lobes' directions; 0.04 is at most two degrees per step"""
    rate_width: float = 0.06
    """Learning rate of the lobes' log widths"""
    rate_chroma: float = 0.01
    """Learning rate of the lobes' log colour ratios"""
    rate_tone: float = 0.01
    """Learning rate of the tone curves"""
    rate_material: float = 0.02
    """Learning rate of --refine material"""
    rate_emission: float = 0.05
    """Learning rate of --refine emission, whose factors range over decades"""
    adam_beta1: float = 0.9
    """Adam's decay of the gradient's mean"""
    adam_beta2: float = 0.99
    """Adam's decay of the gradient's square"""
    consistency: float = 0.03
    """Weight of the term that gives the object's light the shape of the shadow's (eq. 10)"""
    spread: float = 0.01
    """Weight of the Cauchy term that keeps the shadow's light in few directions (eq. 11)"""
    chroma: float = 0.1
    """Weight of the prior that keeps the light's colour near white"""
    tone_bins: int = 5
    """Bins of each tone curve"""
    bend: float = 0.1
    """Weight of the prior that keeps tone curves near the identity"""
    trust: float = 4.0
    """Weight of the term that holds the light near the regressed one, in squares of what that is
    uncertain by; 0: nothing holds it"""
    chroma_limit: float = 1.5
    """Greatest log colour ratio of a lobe"""
    intensity_limit: float = 1e6
    """Greatest factor between a lobe's intensity and that of the start, either way"""
    score_every: int = 25
    """Steps between two scores, of which the best state is kept; 0: the last state is kept"""

    @property
    def step_count(self) -> int:
        """`steps`, or the authors' number."""
        return 600 if self.steps is None else self.steps

    @property
    def fusion_kind(self) -> str:
        """`fusion`, or the authors'."""
        return self.fusion or "schedule"

    @property
    def has_lobe_shape(self) -> bool:
        """`lobe_shape`, or what the authors do."""
        return self.lobe_shape is not False

    @property
    def rate_of_all(self) -> float:
        """`rate`, or 1."""
        return 1.0 if self.rate is None else self.rate

    @property
    def has_tone_curve(self) -> bool:
        """`tone_curve`, or what the authors do."""
        return self.tone_curve is not False

    @property
    def picture_width(self) -> int:
        """`guidance_width`, or the authors' number [px]."""
        return 384 if self.guidance_width is None else self.guidance_width

    @property
    def light_rows(self) -> int:
        """`light_height`, or what Stable Diffusion gets."""
        return 64 if self.light_height is None else self.light_height

    @property
    def object_light_rows(self) -> int:
        """`object_light_height`, or what Stable Diffusion gets."""
        return 32 if self.object_light_height is None else self.object_light_height


@dataclass(frozen=True)
class TaskConfig:
    """What else is done under a known light."""

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


@dataclass(frozen=True)
class OutputConfig:
    """Where results are written, and which."""

    out: str | None = None
    """Folder for everything that is written"""
    overwrite: bool = False
    """Replace results that are already in --out"""
    resume: bool = False
    """Go on from the last checkpoint in --out"""
    mark: bool = True
    """Note in the picture's metadata that it is a composite"""
    hand_off: bool = True
    """Write the files for Blender, three.js and colour tools as well"""
    report: bool = True
    """Write report.html, a page that shows the result, the light and all figures"""
    mitsuba: bool = False
    """Write the insertion as a scene of Mitsuba 3 as well, into a folder of its own"""
