"""A model with the shapes of Stable Diffusion 2.1-base and random weights."""

from pathlib import Path
from typing import Any

import torch

from tests.builders.tiny_stable_diffusion import END, START, write_pipeline, write_tokenizer


def full_size_parts(device: torch.device, start: int, end: int) -> tuple[Any, Any, Any]:
    """Return UNet, autoencoder and text encoder of Stable Diffusion 2.1-base, random, in fp16.

    Start and end are the tokenizer's ids of a prompt's.
    """
    from diffusers import AutoencoderKL, UNet2DConditionModel
    from transformers import CLIPTextConfig, CLIPTextModel

    torch.manual_seed(0)
    with device:
        unet = UNet2DConditionModel(
            sample_size=64,
            block_out_channels=(320, 640, 1280, 1280),
            layers_per_block=2,
            attention_head_dim=(5, 10, 20, 20),
            cross_attention_dim=1024,
            use_linear_projection=True,
        )
        vae = AutoencoderKL(
            sample_size=768,
            block_out_channels=(128, 256, 512, 512),
            layers_per_block=2,
            down_block_types=("DownEncoderBlock2D",) * 4,
            up_block_types=("UpDecoderBlock2D",) * 4,
        )
        text_encoder = CLIPTextModel(
            CLIPTextConfig(
                vocab_size=49408,
                hidden_size=1024,
                intermediate_size=4096,
                num_hidden_layers=23,
                num_attention_heads=16,
                max_position_embeddings=77,
                hidden_act="gelu",
                projection_dim=512,
                bos_token_id=start,
                eos_token_id=end,
            )
        )
    return unet.half(), vae.half(), text_encoder.half()


def write_model(folder: Path, device: torch.device) -> None:
    """Write a random pipeline with the shapes of Stable Diffusion 2.1-base."""
    vocabulary = write_tokenizer(folder / "tokenizer")
    write_pipeline(folder, full_size_parts(device, vocabulary[START], vocabulary[END]))
