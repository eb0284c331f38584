"""What the recorded samples of `mis` stand for, restated in float64: sums over them, and a tape."""

import numpy as np
import torch
import warp as wp
from torch import Tensor

from tests import oracles
from warpir.core.arrays import BoolArray, Float64Array, FloatArray
from warpir.kernels.shade import shade_vertex
from warpir.kernels.types import LightRecord, VertexRecord
from warpir.render.integrator import MaterialTensors
from warpir.render.mis.samples import ObjectSamples
from warpir.render.renderer import Renderer
from warpir.render.upload.materials import FACTORS


def plain_factors(materials: MaterialTensors) -> list[FloatArray | None]:
    """The four material factors as arrays."""
    tensors = (materials.base_color, materials.metallic, materials.roughness, materials.emission)
    return [None if t is None else t.detach().cpu().numpy() for t in tensors]


def factor_arrays(renderer: Renderer, factors: list[FloatArray | None]) -> list[wp.array]:
    """The four factors on the device; the scene's own where None."""
    materials = renderer.scene.materials_with(factors)
    return [getattr(materials, name) for name, _ in FACTORS]


def used(record: LightRecord) -> BoolArray:
    """Which entries are filled, shape [pixel, capacity]."""
    filled: BoolArray = np.arange(record.wi.shape[1]) < record.count.numpy()[:, None]
    return filled


def incident(record: LightRecord, light: Tensor) -> Tensor:
    """Radiance from each filled entry's direction, float64, shape [entry, 3]; differentiable."""
    wi = record.wi.numpy()[used(record)].astype(np.float64)
    texels = light.double()
    rows, columns, weights = oracles.bilinear_weights(oracles.latlong_uv(wi), *texels.shape[:2])
    taps = texels[torch.from_numpy(rows), torch.from_numpy(columns)]
    return (taps * torch.from_numpy(weights)[..., None]).sum(-2)


def pixel_sums(record: LightRecord, gathered: Tensor) -> Tensor:
    """Add up each pixel's entries, shape [pixel, 3]."""
    pixel = torch.from_numpy(np.nonzero(used(record))[0])
    return torch.zeros(len(record.count), 3, dtype=torch.float64).index_add(0, pixel, gathered)


def object_sums(record: LightRecord, light: Tensor) -> Tensor:
    """The object's pixels under ``light``, without what it emits, shape [pixel, 3]."""
    weight = torch.from_numpy(record.weight.numpy()[used(record)].astype(np.float64))
    return pixel_sums(record, weight * incident(record, light))


def plane_sums(record: LightRecord, light: Tensor) -> tuple[Tensor, Tensor]:
    """The plane's pixels with and without the object, shape [pixel, 3] each."""
    weight = torch.from_numpy(record.weight.numpy()[used(record)].astype(np.float64))
    Li = incident(record, light)
    return pixel_sums(record, weight[:, 0:1] * Li), pixel_sums(record, weight[:, 1:2] * Li)


def shade_vertices(
    samples: ObjectSamples, record: VertexRecord, factors: list[wp.array]
) -> list[wp.array]:
    """What each vertex of each path adds, by the attached kernel; a tape may listen."""
    pixels, device = record.material.shape[0], samples.mis.renderer.device
    paths = pixels * samples.path_count

    def new(value: float) -> wp.array:
        return wp.full(paths, wp.vec3(value), dtype=wp.vec3, device=device, requires_grad=True)

    throughput, contributions = new(1.0), []
    for k in range(samples.mis.depth + 1):
        contributions.append(new(0.0))
        onward = new(0.0)
        wp.launch(
            shade_vertex,
            dim=paths,
            inputs=[record, samples.path_count, k, *factors, throughput],
            outputs=[contributions[k], onward],
            device=device,
        )
        throughput = onward
    return contributions


def path_means(samples: ObjectSamples, contributions: list[wp.array]) -> Float64Array:
    """The object's pixels, shape [pixel, 3]."""
    total = np.sum([c.numpy().astype(np.float64) for c in contributions], axis=0)
    return np.asarray(total.reshape(-1, samples.path_count, 3).mean(axis=1))
