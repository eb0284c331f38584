"""The prior that warpir ships: a small UNet on pixels that is shown what it has to judge by.

A crop of 64 x 64 pixels is its own latent, in [-1, 1]. Beside the noisy crop the network sees the
photo without the object (the crop, blank where the mask covers it, and the whole photo, small), the
object's mask, albedo and normals, and the light that the regressor reads off the photo, as a first
guess; each may be withheld, and a flag says so. It was trained on rendered scenes, half of them
wrongly lit: the prompt says ``consistent`` or ``mismatched`` and what is wrong. The empty prompt
means any of them, wrongly lit ones included, so that a difference of two prompts is a statement
about the light.

Folding 2 x 2 pixels into channels is orthonormal: white noise stays white, and this is exactly
diffusion in pixel space at a quarter of the cost. Noise follows a cosine, ``s = sin(pi t / 2)``,
and the network predicts ``v = a noise - s z`` (Salimans & Ho, arXiv 2202.00512).
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from warpir.core.atomic import write_file
from warpir.diffusion.models.embedded_words import (
    TOKEN_COUNT,
    VOCABULARY,
    VOCABULARY_SIZE,
    tokenize,
)
from warpir.diffusion.models.model_error import ModelError
from warpir.diffusion.models.network_prior import NetworkPrior
from warpir.diffusion.models.tensor_files import read_safetensors, serialize
from warpir.diffusion.models.weight_files import PRIOR_FORMAT as FORMAT
from warpir.diffusion.models.weight_files import PRIOR_KEY as HEADER_KEY
from warpir.diffusion.models.weight_files import SHIPPED, check_prior, values_hash
from warpir.diffusion.prior import InChunks, at_once
from warpir.diffusion.schedule import NoiseSchedule

if TYPE_CHECKING:
    from diffusers import UNet2DConditionModel

RESOLUTION = 64
"""Side of a crop [px]."""
TIMESTEPS = 1000
WEIGHTS = SHIPPED / "prior.safetensors"
"""The weights that are part of the package."""

# The network


@dataclass(frozen=True)
class NetworkConfig:
    """Size of the network; the default has 10.1 M parameters and takes 4.0 GFLOP a picture."""

    widths: tuple[int, ...] = (64, 128, 128)
    """Channels by level, at 32 x 32, 16 x 16 and 8 x 8."""
    layers: int = 2
    """Residual blocks by level."""
    attention_from: int = 1
    """First level with attention."""
    head_width: int = 32
    """Channels of an attention head."""
    groups: int = 16
    """Of the normalisation."""
    embedding_width: int = 128
    """Channels of a word."""


CONDITIONS = ("background", "mask", "albedo", "normals", "light")
"""Each has a flag; the columns of ``present`` below. ``light`` is what the regressor reads off the
photo: without the background it is not shown either."""
GBUFFER_CHANNELS = 13
"""Mask, albedo (3), normals (3), the object as a white-lit diffuse picture would show it under the
regressed light (3), and the direction toward that light times its share, in the camera's frame (3).
"""


class EmbeddedNetwork(nn.Module):
    """Noisy crop, conditions and prompt to v.

    Args:
        config: Its size.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        # Imported here: it takes seconds.
        from diffusers import UNet2DConditionModel

        self.config = config
        levels = range(len(config.widths))
        attends = [level >= config.attention_from for level in levels]
        self.unet: UNet2DConditionModel = UNet2DConditionModel(
            sample_size=RESOLUTION // 2,
            in_channels=4 * (3 + 6 + GBUFFER_CHANNELS) + len(CONDITIONS),
            out_channels=4 * 3,
            down_block_types=tuple(f"{'CrossAttn' * a}DownBlock2D" for a in attends),
            up_block_types=tuple(f"{'CrossAttn' * a}UpBlock2D" for a in reversed(attends)),
            block_out_channels=config.widths,
            layers_per_block=config.layers,
            # diffusers calls the number of heads so.
            attention_head_dim=tuple(max(w // config.head_width, 1) for w in config.widths),
            cross_attention_dim=config.embedding_width,
            norm_num_groups=config.groups,
            use_linear_projection=True,
        )
        self.words = nn.Embedding(VOCABULARY_SIZE, config.embedding_width)
        self.places = nn.Parameter(0.3 * torch.randn(TOKEN_COUNT, config.embedding_width))

    def embed(self, ids: Tensor) -> Tensor:
        """Return embeddings of `tokenize`'s ids, shape [B, `TOKEN_COUNT`, channel]."""
        words: Tensor = self.words(ids)
        return words + self.places

    def forward(
        self,
        latents_noisy: Tensor,
        timesteps: Tensor,
        embeddings: Tensor,
        background: Tensor,
        gbuffer: Tensor,
        present: Tensor,
    ) -> Tensor:
        """Return v, shape [B, 3, 64, 64].

        Args:
            latents_noisy: z_t, same shape.
            timesteps: int64, shape [B].
            embeddings: From `embed`.
            background: The photo without the object, in [0, 1]: the crop, and the whole of it
                squeezed into the same square, shape [B, 6, 64, 64].
            gbuffer: `GBUFFER_CHANNELS`, shape [B, 13, 64, 64].
            present: 1 for each of `CONDITIONS` that is shown, else 0; float, shape [B, 5].
        """
        packed = pack(latents_noisy, background, gbuffer, present)
        predicted: Tensor = self.unet(packed, timesteps, encoder_hidden_states=embeddings).sample
        return functional.pixel_shuffle(predicted, 2)


def pack(latents_noisy: Tensor, background: Tensor, gbuffer: Tensor, present: Tensor) -> Tensor:
    """Return the UNet's input, shape [B, 93, 32, 32]; arguments as in `EmbeddedNetwork.forward`.

    What is not shown is 0. The background is blank where a mask that is shown covers it; the whole
    photo beside it, which has the cues that a crop leaves out, is not.
    """
    # What was read off the photo is not known where the photo is not.
    present = torch.cat([present[:, :4], present[:, 4:] * present[:, :1]], dim=1)
    shown = present[:, :, None, None].to(latents_noisy)
    mask = gbuffer[:, :1] * shown[:, 1:2]
    planes = [
        latents_noisy,
        (2.0 * background[:, :3] - 1.0) * (1.0 - mask) * shown[:, :1],
        (2.0 * background[:, 3:] - 1.0) * shown[:, :1],
        mask,
        gbuffer[:, 1:4] * shown[:, 2:3],
        gbuffer[:, 4:7] * shown[:, 3:4],
        gbuffer[:, 7:] * shown[:, 4:],
    ]
    folded = functional.pixel_unshuffle(torch.cat(planes, dim=1), 2)
    return torch.cat([folded, shown.expand(-1, -1, *folded.shape[-2:])], dim=1)


def build_network(config: NetworkConfig | None = None, seed: int = 0) -> EmbeddedNetwork:
    """Return a network with random weights; the global random numbers are left alone."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return EmbeddedNetwork(config or NetworkConfig())


def cosine_schedule() -> NoiseSchedule:
    """Return the schedule ``a = cos(pi t / 2), s = sin(pi t / 2)``, t in the middle of a step."""
    t = (torch.arange(TIMESTEPS, dtype=torch.float64) + 0.5) / TIMESTEPS
    return NoiseSchedule(torch.cos(0.5 * math.pi * t).square(), "v_prediction")


# The prior


class EmbeddedPrior(NetworkPrior):
    """The network behind `warpir.diffusion.prior.Prior`; made by `load_embedded`.

    Always computes in fp32: it is small, and differences need it.

    Args:
        network: On its device, fp32; frozen from now on.
        file_hashes: sha256 by name of every file that it was made of.
        training: How the weights came about, from their file; empty for random ones.
        graphs: Record what is done often as CUDA graphs; the device must be one.
        in_chunks: How larger batches are computed.
    """

    name = "embedded"

    def __init__(
        self,
        network: EmbeddedNetwork,
        file_hashes: Mapping[str, str],
        training: Mapping[str, Any] | None = None,
        graphs: bool = False,
        in_chunks: InChunks = at_once,
    ) -> None:
        self.network = network.requires_grad_(False).eval()
        self.training = dict(training or {})
        schedule = cosine_schedule()
        bar = schedule.alphas_cumprod
        before = torch.cat([torch.ones(1, dtype=bar.dtype), bar[:-1]])
        solver_config = {
            "num_train_timesteps": TIMESTEPS,
            "trained_betas": (1.0 - bar / before).tolist(),
            "prediction_type": schedule.prediction_type,
        }
        shape = (3, RESOLUTION, RESOLUTION)
        super().__init__(
            network.unet,
            schedule,
            solver_config,
            shape,
            RESOLUTION,
            file_hashes,
            graphs,
            in_chunks,
        )

    def encode(self, image: Tensor) -> Tensor:
        """Return the picture in [-1, 1], float32: a pixel is its own latent.

        Args:
            image: Display-encoded, in [0, 1], shape [B, 3, 64, 64].

        Raises:
            ValueError: The image has another shape.
        """
        if image.ndim != 4 or image.shape[1:] != self.latent_shape:
            raise ValueError(
                f"image: shape {tuple(image.shape)} (expected [B, 3, R, R], {self.latent_shape})"
            )
        return 2.0 * image.to(self.device, torch.float32) - 1.0

    @torch.no_grad()
    def decode(self, latents: Tensor) -> Tensor:
        """Return pictures, float32, in [0, 1], shape [B, 3, 64, 64]."""
        return (latents.to(self.device) / 2.0 + 0.5).clamp(0.0, 1.0)

    def free_text_encoder(self) -> None:
        """Keep the table of words: there is nothing to gain."""

    def pack(
        self,
        latents_noisy: Tensor,
        background: Tensor | None = None,
        gbuffer: Tensor | None = None,
        keep_background: Sequence[bool] | None = None,
    ) -> Tensor:
        """Return the UNet's input, see `pack`; what is None is not shown.

        Raises:
            ValueError: A condition is not of the latents' size.
        """
        count, size = len(latents_noisy), latents_noisy.shape[-2:]
        device = latents_noisy.device
        for name, given, channels in (
            ("background", background, 6),
            ("gbuffer", gbuffer, GBUFFER_CHANNELS),
        ):
            if given is not None and given.shape != (count, channels, *size):
                expected = [count, channels, *size]
                raise ValueError(f"{name}: shape {list(given.shape)} (expected {expected})")
        if keep_background is not None and len(keep_background) != count:
            raise ValueError(f"keep_background: {len(keep_background)} (expected {count})")
        # Made on the device: what is uploaded here could not be recorded as a CUDA graph.
        present = latents_noisy.new_zeros(count, len(CONDITIONS))
        present[:, 1:] = float(gbuffer is not None)
        present[:, 0] = float(background is not None)
        if background is not None and keep_background is not None:
            present[:, 0] = torch.tensor(keep_background, dtype=present.dtype).to(device)
        zeros = latents_noisy.new_zeros(count, GBUFFER_CHANNELS, *size)
        return pack(
            latents_noisy,
            zeros[:, :6] if background is None else background.to(device, torch.float32),
            zeros if gbuffer is None else gbuffer.to(device, torch.float32),
            present,
        )

    def unpack(self, predicted: Tensor) -> Tensor:
        """Return what the UNet put out, shape [B, 3, 64, 64]."""
        return functional.pixel_shuffle(predicted, 2)

    @torch.no_grad()
    def _encode_text(self, prompt: str) -> Tensor:
        """Return a prompt's embedding, float32, shape [token, channel]."""
        return self.network.embed(torch.tensor(tokenize(prompt), device=self.device))


def random_embedded(
    seed: int, device: torch.device | str, config: NetworkConfig | None = None
) -> EmbeddedPrior:
    """Return a prior that knows nothing: random weights, for tests and as a control."""
    network = build_network(config, seed)
    hashes = {f"random weights, seed {seed}": weight_hash(network.state_dict())}
    return EmbeddedPrior(network.to(device), hashes)


# Files


def save_embedded(network: EmbeddedNetwork, path: Path, training: Mapping[str, Any]) -> None:
    """Write a network's weights in fp16, always the same bytes.

    Args:
        network: The network.
        path: A safetensors file; its folder is made.
        training: How the weights came about, as plain JSON values.

    Raises:
        OSError: The file cannot be written; an older one is still whole.
    """
    weights = {name: value.detach().cpu().half() for name, value in network.state_dict().items()}
    described = {
        "format": FORMAT,
        "network": asdict(network.config),
        "vocabulary": VOCABULARY,
        "schedule": "cosine",
        "weights": weight_hash(weights),
        "training": training,
    }
    header = {"format": "pt", HEADER_KEY: json.dumps(described, sort_keys=True)}
    write_file(path, serialize(weights, header))


def load_embedded(
    weights: Path | str | None,
    device: torch.device | str,
    graphs: bool = False,
    in_chunks: InChunks = at_once,
) -> EmbeddedPrior:
    """Load a prior.

    Args:
        weights: A file of `save_embedded`; None: the one that is part of the package.
        device: Where it computes.
        graphs: Record what is done often as CUDA graphs; the device must be one.
        in_chunks: How larger batches are computed.

    Raises:
        ModelError: The file is not there, is damaged or holds something else.
    """
    path = Path(weights) if weights is not None else WEIGHTS
    if weights is None and not path.is_file():
        what = "the embedded prior's weights are not in this installation"
        raise ModelError(str(path), what, "name some by --prior, or leave --steps out")
    network, training = read_network(path)
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return EmbeddedPrior(network.to(device), {path.name: digest}, training, graphs, in_chunks)


def read_network(path: Path) -> tuple[EmbeddedNetwork, dict[str, Any]]:
    """Return the network of a file, fp32 on the CPU, and how its weights came about.

    Raises:
        ModelError: The file is not there, is damaged or holds something else.
    """
    described = check_prior(path)
    training = described.get("training")
    if not isinstance(training, dict):
        raise ModelError(str(path), "its header is damaged (training)")
    if described.get("vocabulary") != list(VOCABULARY) or described.get("schedule") != "cosine":
        what = "made for another vocabulary or schedule than this version of warpir has"
        raise ModelError(str(path), what, "fetch the weights of this version")
    size = described["network"]
    config = NetworkConfig(**{**size, "widths": tuple(size["widths"])})
    return network_of(config, read_safetensors(path)[0], str(path)), training


def network_of(config: NetworkConfig, weights: Mapping[str, Tensor], where: str) -> EmbeddedNetwork:
    """Return a network with these weights, as fp32.

    Args:
        config: Its size.
        weights: By name, as in its ``state_dict``.
        where: What an error names.

    Raises:
        ModelError: The weights are not this network's.
    """
    with torch.device("meta"):  # neither memory nor random numbers
        network = EmbeddedNetwork(config)
    try:
        network.load_state_dict({k: v.float() for k, v in weights.items()}, assign=True)
    except RuntimeError as error:
        reason = " ".join(str(error).split())[:160]
        raise ModelError(where, f"the weights do not fit the network; {reason}") from error
    return network


def weight_hash(weights: Mapping[str, Tensor]) -> str:
    """Return the sha256 of weights as they are written: names and fp16 values in order."""
    return values_hash({name: v.detach().cpu().half().numpy() for name, v in weights.items()})
