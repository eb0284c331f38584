"""What a user may choose about the diffusion model; plain values, importable without torch.

Each field is one flag of `warpir.insert`, and the line below it is its ``--help``. Defaults are the
authors' (DiPIR, Liang et al. 2024) where they state one, else ours. What is None is open: the
prior that guides decides it (`warpir.app.config.PRIOR_DEFAULTS`).
"""

from dataclasses import dataclass

PREDICTION_TYPES = ("epsilon", "v_prediction", "sample")
"""What a network may predict: the noise, v, or the clean sample."""


@dataclass(frozen=True)
class ModelSettings:
    """Which Stable Diffusion, and how it is computed."""

    model: str | None = None
    """Stable Diffusion 2.x (or 1.5): a folder in diffusers' layout, or a hub id"""
    precision: str = "fp16"
    """Arithmetic of the UNet: fp16, bf16 or fp32 (the CPU always uses fp32); fp16 falls back to
    fp32 where it spoils the guidance"""
    vae_precision: str = "fp16"
    """Arithmetic of the VAE: fp16, bf16 or fp32"""
    vae_checkpointing: bool = False
    """Recompute the VAE encoder in its backward pass, which needs a tenth of the memory (1.5 GB
    less per noise) and half as much time again"""
    allow_download: bool = False
    """Let a hub id be downloaded; without it only what is on this machine is used"""
    allow_pickle: bool = False
    """Read weights that a model folder has as pickles (.bin) alone, by torch's reader of plain
    tensors, which runs no code of theirs"""
    graphs: bool = True
    """Record the model's passes once as CUDA graphs and replay them, which is faster"""


@dataclass(frozen=True)
class PersonalizeSettings:
    """How the model is adapted to the photo (DiPIR, section 4.2.1)."""

    personalize: bool | None = None
    """Adapt the model to the photo by a LoRA before it guides"""
    token: str = "sks"
    """Rare word that stands for the photo's style in the prompts"""
    class_noun: str | None = None
    """What the object is, in a word, for the class images (default: the prompt's last word)"""
    class_images: int | None = None
    """Class images that preserve the concept; 0: none, as an ablation (default: 200, or 40 with
    --indoors)"""
    indoors: bool = False
    """The photo shows a room, so fewer class images are needed"""
    class_steps: int = 25
    """Denoising steps of a class image (DPM-Solver++)"""
    class_scale: float = 7.5
    """Classifier-free guidance of a class image"""
    class_batch: int = 8
    """Class images made at once"""
    lora: str | None = None
    """LoRA file (safetensors; diffusers, kohya or peft keys) to use in place of training one"""
    lora_rank: int = 4
    """Rank of the LoRA; its alpha is the same number"""
    lora_layers: tuple[str, ...] = ("to_q", "to_k", "to_v", "to_out.0")
    """Layers of the UNet that the LoRA adapts"""
    lora_steps: int = 1000
    """Training steps of the LoRA"""
    lora_rate: float = 1e-4
    """Learning rate of the LoRA (AdamW)"""
    lora_class_batch: int = 1
    """Class images beside the photo's crop in each training step"""
    lora_class_weight: float = 1.0
    """Weight of the class images' loss (prior preservation)"""
    lora_decay: float = 1e-2
    """Weight decay of the LoRA (AdamW)"""
    lora_clip: float = 1.0
    """Greatest norm of the LoRA's gradient"""
    lora_crop: float = 0.7
    """Smallest side of the photo's crops while training, as a share of its shorter side"""


@dataclass(frozen=True)
class GuidanceOptions:
    """What every prior is asked in the same way."""

    negative_prompt: str = ""
    """What the losses with a negative term move away from (default: of the embedded prior, the same
    words with another light)"""
    base_prompt: str = ""
    """What the terms without the LoRA ask for (default: what the adapted model is asked for)"""
    null_prompt: str = ""
    """What the unconditional term is asked for"""
    literal_alpha: bool = False
    """Multiply w(t) by sqrt(alpha_bar), as equations 7 and 8 read literally"""
    gradient_clip: float = 10.0
    """Greatest norm of a gradient, in running medians; 0: no limit"""
    update_every: int = 10
    """Steps between two edits of the picture, for dataset-update"""
    update_steps: int = 20
    """Denoising steps of such an edit (DDIM)"""
    update_scale: float = 7.5
    """Classifier-free guidance of such an edit"""


@dataclass(frozen=True)
class GuidanceSettings(GuidanceOptions):
    """How a prior's opinion becomes a gradient (DiPIR, eq. 7, 8); Stable Diffusion's defaults."""

    loss: str = "lds"
    """lds, sds, sds-base (no LoRA), csd, lds-lora-both, lds-negative, good-bad, sds-good-bad, or
    dataset-update"""
    guidance_scale: float = 100.0
    """g of the SDS losses: g e(prompt) + (1 - g) e(null) - noise"""
    null_background: str = "keep"
    """Whether the null and negative terms see the photo: keep or drop (Stable Diffusion sees only
    the composite)"""
    time_min: float = 0.02
    """Least noise level, as a share of the schedule"""
    time_max: float = 0.6
    """Greatest noise level at the start, as a share of the schedule"""
    time_max_end: float = 0.3
    """Greatest noise level at the end; falls linearly"""
    weight: str = "sigma2"
    """Weight w(t) of the residual: sigma2 (1 - alpha_bar), sigma or uniform"""
    noises: int = 1
    """Noises and times per rendered picture"""
    crop_min: float = 0.5
    """Smallest side of a crop, in sides of the object's box"""
    crop_max: float = 3.0
    """Greatest side of a crop, in sides of the object's box"""


@dataclass(frozen=True)
class GuidanceChoices(GuidanceOptions):
    """`GuidanceSettings` as a user may leave them open; their help is there."""

    loss: str | None = None
    guidance_scale: float | None = None
    null_background: str | None = None
    time_min: float | None = None
    time_max: float | None = None
    time_max_end: float | None = None
    weight: str | None = None
    noises: int | None = None
    crop_min: float | None = None
    crop_max: float | None = None
