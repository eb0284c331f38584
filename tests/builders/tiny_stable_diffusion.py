"""A folder shaped like Stable Diffusion 2, made in a moment, for tests without a network.

Parts and configurations follow diffusers' own dummy components for Stable Diffusion 2; weights are
random. The autoencoder has four blocks, so that a latent is an eighth of its picture as in the real
model. As in the real 2.1, the tokenizer has no ``tokenizer.json`` and pads with ``!``.
"""

import json
from pathlib import Path
from typing import Any

import torch

import warpir.diffusion  # noqa: F401

WORDS = ("scene", "style", "sks", "rendering")
"""Words that are one token each; all others are spelled in letters."""
START, END = "<|startoftext|>", "<|endoftext|>"
RESOLUTION = 64
"""Side of the pictures that the model judges [px]: a latent of 8 x 8."""
ATTENTION = ("to_q", "to_k", "to_v", "to_out.0")
"""Layers that a LoRA adapts by default."""


def make_tiny_stable_diffusion(
    folder: Path,
    prediction_type: str = "epsilon",
    zero_terminal_snr: bool = False,
    cross_attention_dim: int = 32,
) -> Path:
    """Write a random pipeline in diffusers' layout, as safetensors; about 5 MB.

    Args:
        folder: Where; made when it does not exist.
        prediction_type: ``epsilon``, ``v_prediction`` or ``sample``, for the scheduler's config.
        zero_terminal_snr: Rescale the schedule so that its last step has no signal.
        cross_attention_dim: Width of the prompt's embeddings, a multiple of 4; 1024 in Stable
            Diffusion 2, 768 in 1.5.

    Returns:
        ``folder``.
    """
    # Not at the top: warpir.diffusion has to come before them, as it hides our kernels folder.
    from diffusers import AutoencoderKL, UNet2DConditionModel
    from transformers import CLIPTextConfig, CLIPTextModel

    vocabulary = write_tokenizer(folder / "tokenizer")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        unet = UNet2DConditionModel(
            sample_size=RESOLUTION // 8,
            block_out_channels=(32, 64),
            layers_per_block=1,
            attention_head_dim=(2, 4),
            use_linear_projection=True,
            cross_attention_dim=cross_attention_dim,
            norm_num_groups=8,
            down_block_types=("DownBlock2D", "CrossAttnDownBlock2D"),
            up_block_types=("CrossAttnUpBlock2D", "UpBlock2D"),
        )
        vae = AutoencoderKL(
            sample_size=RESOLUTION,
            block_out_channels=(16, 16, 32, 32),
            down_block_types=("DownEncoderBlock2D",) * 4,
            up_block_types=("UpDecoderBlock2D",) * 4,
            latent_channels=4,
            norm_num_groups=8,
        )
        text_encoder = CLIPTextModel(
            CLIPTextConfig(
                vocab_size=len(vocabulary),
                hidden_size=cross_attention_dim,
                intermediate_size=64,
                num_hidden_layers=2,
                num_attention_heads=4,
                max_position_embeddings=77,
                hidden_act="gelu",
                bos_token_id=vocabulary[START],
                eos_token_id=vocabulary[END],
            )
        )
    write_pipeline(
        folder,
        (unet, vae, text_encoder),
        prediction_type=prediction_type,
        rescale_betas_zero_snr=zero_terminal_snr,
        timestep_spacing="trailing" if zero_terminal_snr else "leading",
    )
    (folder / "tokenizer" / "tokenizer.json").unlink()
    write_tokenizer(folder / "tokenizer")
    return folder


def add_lora(
    prior: Any, name: str, seed: int, gain: float = 0.2, layers: tuple[str, ...] = ATTENTION
) -> None:
    """Add a LoRA to a loaded model that does something: peft starts B at zero."""
    from peft import LoraConfig

    config = LoraConfig(r=4, lora_alpha=4, target_modules=list(layers))
    prior.unet.add_adapter(config, adapter_name=name)
    generator = torch.Generator().manual_seed(seed)
    for key, weight in prior.unet.named_parameters():
        if f"lora_B.{name}" in key:
            weight.data = gain * torch.randn(weight.shape, generator=generator)
        weight.requires_grad_(False)
    prior.adapters.add(name)


def edit_json(path: Path, **values: object) -> None:
    """Change values of a JSON object in a file."""
    path.write_text(json.dumps({**json.loads(path.read_text()), **values}))


def write_pipeline(folder: Path, parts: tuple[Any, Any, Any], **schedule: Any) -> None:
    """Write UNet, autoencoder and text encoder beside their tokenizer, which is in ``folder``.

    The schedule is Stable Diffusion's, with what is given besides.
    """
    from diffusers import DDIMScheduler, StableDiffusionPipeline
    from transformers import CLIPTokenizer

    unet, vae, text_encoder = parts
    StableDiffusionPipeline(
        vae=vae,
        text_encoder=text_encoder,
        tokenizer=CLIPTokenizer.from_pretrained(folder / "tokenizer"),
        unet=unet,
        scheduler=DDIMScheduler(
            beta_schedule="scaled_linear",
            beta_start=0.00085,
            beta_end=0.012,
            steps_offset=1,
            clip_sample=False,
            set_alpha_to_one=False,
            **schedule,
        ),
        safety_checker=None,
        feature_extractor=None,
        requires_safety_checker=False,
    ).save_pretrained(folder)


def write_tokenizer(folder: Path) -> dict[str, int]:
    """Write a byte-level BPE tokenizer as CLIP's; return its vocabulary."""
    # The printable bytes stand for themselves, the others for characters from 256 on (GPT-2).
    printable = [*range(ord("!"), ord("~") + 1), *range(0xA1, 0xAD), *range(0xAE, 0x100)]
    symbols = [chr(byte) for byte in printable]
    symbols += [chr(256 + place) for place in range(256 - len(printable))]
    merges: list[tuple[str, str]] = []
    for word in WORDS:
        pieces = [*word[:-1], word[-1] + "</w>"]
        start = pieces[0]
        for piece in pieces[1:]:
            if (start, piece) not in merges:
                merges.append((start, piece))
            start += piece
    names = [*symbols, *(symbol + "</w>" for symbol in symbols), *("".join(m) for m in merges)]
    vocabulary = {name: place for place, name in enumerate([*names, START, END])}
    special = {"bos_token": START, "eos_token": END, "unk_token": END, "pad_token": "!"}
    config = {"tokenizer_class": "CLIPTokenizer", "model_max_length": 77, "do_lower_case": True}

    folder.mkdir(parents=True, exist_ok=True)
    lines = ["#version: 0.2", *(" ".join(merge) for merge in merges), ""]
    (folder / "merges.txt").write_text("\n".join(lines), encoding="utf-8")
    for name, content in (
        ("vocab.json", vocabulary),
        ("special_tokens_map.json", special),
        ("tokenizer_config.json", {**config, **special}),
    ):
        (folder / name).write_text(json.dumps(content, ensure_ascii=False), encoding="utf-8")
    return vocabulary
