"""What a user may choose about the optimisation loop; plain values, importable without torch.

Each field is one flag of `warpir.insert`, and the line below it is its ``--help``. Defaults are the
authors' (DiPIR, Liang et al. 2024) where they state one, else ours. What is None is open: the prior
that guides decides it (`warpir.app.config.PRIOR_DEFAULTS`), and here it means the authors' number
or what Stable Diffusion gets.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class OptimizeSettings:
    """How light and tone curves are recovered from the guidance's gradient."""

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
