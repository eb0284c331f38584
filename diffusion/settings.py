"""What a user may choose about the diffusion model; plain values, importable without torch.

Each field is one flag of `warpir.insert`: its range and form stand on it (`warpir.core.options`),
and its help below it. Defaults are the authors' (DiPIR, Liang et al. 2024) where they state one,
else ours.
"""

from dataclasses import dataclass

from warpir.core.options import option

PREDICTION_TYPES = ("epsilon", "v_prediction", "sample")
"""What a network may predict: the noise, v, or the clean sample."""


@dataclass(frozen=True)
class ModelSettings:
    """Which Stable Diffusion, and how it is computed."""

    model: str | None = option(None, "DIR|ID")
    """Stable Diffusion: a folder in diffusers' layout, or a hub id; 2.x (or 1.5)"""
    precision: str = option("fp16", "NAME", expert=True, choices=("fp16", "bf16", "fp32"))
    """Arithmetic of the UNet: fp16, bf16 or fp32 (the CPU always uses fp32); fp16 falls back to
    fp32 where it spoils the guidance"""
    vae_precision: str = option("fp16", "NAME", expert=True, choices=("fp16", "bf16", "fp32"))
    """Arithmetic of the VAE: fp16, bf16 or fp32"""
    vae_checkpointing: bool = option(False, expert=True)
    """Recompute the VAE encoder in its backward pass, which needs a tenth of the memory (1.5 GB
    less per noise) and half as much time again"""
    allow_download: bool = option(False, by_hand=True)
    """Let a hub id be downloaded; without it only what is on this machine is used"""
    allow_pickle: bool = option(False, by_hand=True)
    """Read weights that a model has as pickles alone; (.bin), by torch's reader of plain tensors,
    which runs no code of theirs"""
    graphs: bool = option(True, expert=True)
    """Record the model's passes once as CUDA graphs and replay them, which is faster"""


@dataclass(frozen=True)
class PersonalizeSettings:
    """How the model is adapted to the photo (DiPIR, section 4.2.1)."""

    personalize: bool = option(True, expert=True)
    """Adapt the model to the photo by a LoRA before it guides"""
    token: str = option("sks", "WORD", expert=True, is_prompt=True)
    """Rare word that stands for the photo's style in the prompts"""
    class_noun: str | None = option(None, "WORD", expert=True, is_prompt=True)
    """What the object is, in a word, for the class images (default: the prompt's last word)"""
    class_images: int | None = option(None, "N", expert=True, low=0, high=10_000)
    """Class images that preserve the concept; 0: none, as an ablation (default: 200, or 40 with
    --indoors)"""
    indoors: bool = option(False, expert=True)
    """The photo shows a room, so fewer class images are needed"""
    class_steps: int = option(25, "N", expert=True, low=1, high=1000)
    """Denoising steps of a class image (DPM-Solver++)"""
    class_scale: float = option(7.5, "G", expert=True, low=0, high=1000)
    """Classifier-free guidance of a class image"""
    class_batch: int = option(8, "N", expert=True, low=1, high=256)
    """Class images made at once"""
    lora: str | None = option(None, "FILE", expert=True)
    """LoRA file (safetensors; diffusers, kohya or peft keys) to use in place of training one"""
    lora_rank: int = option(4, "N", expert=True, low=1, high=1024)
    """Rank of the LoRA; its alpha is the same number"""
    lora_layers: tuple[str, ...] = option(
        ("to_q", "to_k", "to_v", "to_out.0"), "NAME,NAME", expert=True
    )
    """Layers of the UNet that the LoRA adapts"""
    lora_steps: int = option(1000, "N", expert=True, low=0, high=10**6)
    """Training steps of the LoRA"""
    lora_rate: float = option(1e-4, "R", expert=True, above=0, high=1)
    """Learning rate of the LoRA (AdamW)"""
    lora_class_batch: int = option(1, "N", expert=True, low=1, high=64)
    """Class images beside the photo's crop in each training step"""
    lora_class_weight: float = option(1.0, "W", expert=True, low=0, high=1000)
    """Weight of the class images' loss (prior preservation)"""
    lora_decay: float = option(1e-2, "W", expert=True, low=0, high=1)
    """Weight decay of the LoRA (AdamW)"""
    lora_clip: float = option(1.0, "NORM", expert=True, low=1e-9)
    """Greatest norm of the LoRA's gradient"""
    lora_crop: float = option(0.7, "SHARE", expert=True, low=0.05, high=1)
    """Smallest side of the photo's crops while training, as a share of its shorter side"""


@dataclass(frozen=True)
class GuidanceSettings:
    """How a prior's opinion becomes a gradient (DiPIR, eq. 7, 8)."""

    negative_prompt: str = option("", "TEXT", expert=True, is_prompt=True, may_be_empty=True)
    """What the losses with a negative term move away from"""
    base_prompt: str = option("", "TEXT", expert=True, is_prompt=True, may_be_empty=True)
    """What the terms without the LoRA ask for (default: what the adapted model is asked for)"""
    null_prompt: str = option("", "TEXT", expert=True, is_prompt=True, may_be_empty=True)
    """What the unconditional term is asked for"""
    literal_alpha: bool = option(False, expert=True)
    """Multiply w(t) by sqrt(alpha_bar), as equations 7 and 8 read literally"""
    gradient_clip: float = option(10.0, "MEDIANS", expert=True, low=0)
    """Greatest norm of a gradient, in running medians; 0: no limit"""
    update_every: int = option(10, "N", expert=True, low=1, high=10**6)
    """Steps between two edits of the picture, for dataset-update"""
    update_steps: int = option(20, "N", expert=True, low=1, high=1000)
    """Denoising steps of such an edit (DDIM)"""
    update_scale: float = option(7.5, "G", expert=True, low=0, high=1000)
    """Classifier-free guidance of such an edit"""
    loss: str = option(
        "lds",
        "NAME",
        choices=(
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
    )
    """How the prior's opinion becomes a gradient; lds, sds, sds-base (no LoRA), csd, lds-lora-both,
    lds-negative, good-bad, sds-good-bad, or dataset-update"""
    guidance_scale: float = option(100.0, "G", expert=True, low=0, high=10_000)
    """g of the SDS losses: g e(prompt) + (1 - g) e(null) - noise"""
    time_min: float = option(0.02, "SHARE", expert=True, low=0, high=1)
    """Least noise level, as a share of the schedule"""
    time_max: float = option(0.6, "SHARE", expert=True, low=0, high=1)
    """Greatest noise level at the start, as a share of the schedule"""
    time_max_end: float = option(0.3, "SHARE", expert=True, low=0, high=1)
    """Greatest noise level at the end; falls linearly"""
    weight: str = option("sigma2", "NAME", expert=True, choices=("sigma2", "sigma", "uniform"))
    """Weight w(t) of the residual: sigma2 (1 - alpha_bar), sigma or uniform"""
    noises: int = option(1, "N", expert=True, low=1, high=64)
    """Noises and times per rendered picture"""
    crop_min: float = option(0.5, "SIDES", expert=True, low=0.01, high=100)
    """Smallest side of a crop, in sides of the object's box"""
    crop_max: float = option(3.0, "SIDES", expert=True, low=0.01, high=100)
    """Greatest side of a crop, in sides of the object's box"""
