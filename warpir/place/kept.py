"""What the process for the page keeps between two jobs."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from warpir.app.config import InsertConfig
from warpir.app.inputs import Inputs, Loaders, file_state, read_light, read_photo_of
from warpir.app.settings import InputConfig, LightConfig
from warpir.core.arrays import Float64Array, FloatArray
from warpir.core.latlong import resize_map
from warpir.core.limits import Limits
from warpir.core.progress import Log
from warpir.io.images.envmap_conventions import IN_CAMERA_AXES
from warpir.io.images.photos import Photo
from warpir.place.preview_asset import preview_asset
from warpir.scene.asset import Asset
from warpir.scene.camera import Camera
from warpir.scene.light import Light

if TYPE_CHECKING:
    from warpir.lighting.regression import Regression

LIGHT_ROWS = 512
"""Rows of a given panorama for a preview, at most."""
LIGHTS = 4
"""Estimated lights that are kept: undo goes back to cameras of before."""

PhotoKey = tuple[InputConfig, Limits]


class Kept(Loaders):
    """Reads as `Loaders` do, and remembers the photo too, and what follows from it and the object.

    Photo and object are those of one session: what was read is not read again.
    """

    def __init__(self) -> None:
        super().__init__()
        self._read = lru_cache(maxsize=1)(read_photo_of)
        self.photo = lambda asked, limits: self._read(*_key(asked, limits))
        self._small: tuple[Photo, tuple[int, int], Photo] | None = None
        self._thin: tuple[InputConfig, Asset] | None = None
        self._light = lru_cache(maxsize=LIGHTS)(self._regression)
        self._given: tuple[object, Light, list[str]] | None = None
        self.light = self._small_light

    def shrunk(self, inputs: Inputs, width: int) -> Inputs:
        """Return the inputs with photo, camera and masks at most this wide [px]."""
        photo, camera = inputs.photo, inputs.camera
        occluder, shaded = inputs.occluder, inputs.shadow_mask
        if camera.width <= width:
            return inputs
        size = width, max(1, round(width * camera.height / camera.width))
        if self._small is None or self._small[0] is not photo or self._small[1] != size:
            self._small = photo, size, _small_photo(photo, size)
        occluder = None if occluder is None else _small_plane(occluder, size)
        if shaded is not None:
            shaded = replace(shaded, shares=_small_plane(shaded.shares, size))
        small = replace(inputs, photo=self._small[2], camera=camera.scaled(*size))
        return replace(small, occluder=occluder, shadow_mask=shaded)

    def thinned(self, inputs: Inputs, asked: InputConfig) -> Inputs:
        """Return the inputs with the object as the browser has it, where it is that heavy."""
        key = replace(asked, occluder_mask=None)
        if self._thin is None or self._thin[0] != key:
            self._thin = key, preview_asset(inputs.asset)
        return replace(inputs, asset=self._thin[1])

    def regression(self, config: InsertConfig, camera: Camera) -> Regression:
        """Return the light that the regressor sees in the photo, exposed, by its camera.

        Raises:
            InputError: The photo or the weights cannot be read.
        """
        lens = camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy
        # From the page and through a file it is the same camera but for the last digits.
        pose = tuple(float(part) for part in np.round(camera.c2w, 9).ravel())
        key = _key(config.inputs, config.limits)
        return self._light(key, config.light.regressor, lens, pose)

    def _small_light(
        self,
        asked: LightConfig,
        strict: bool,
        camera_to_world: Float64Array,
        limits: Limits,
        log: Log,
    ) -> Light | None:
        """Return what --light holds, a large panorama made smaller, read once for all its turns.

        A file that has changed is read again, as the insertion will.
        """
        if (file := asked.file) is None:
            return None
        asked, turn = replace(asked, rotate=0.0), asked.rotate
        axes = camera_to_world.tobytes() if asked.convention in IN_CAMERA_AXES else b""
        key = file, file_state(Path(file)), asked.convention, asked.fit_lobes, strict, limits, axes
        if self._given is None or self._given[0] != key:
            about = Log()
            light = read_light(asked, strict, camera_to_world, limits, about)
            assert light is not None
            if light.texels is not None:
                rows = min(len(light.texels), LIGHT_ROWS)
                light = Light(texels=resize_map(light.texels, rows))
            self._given = key, light, about.notices
        log.notice(*self._given[2])
        return self._given[1].rotated(turn)

    def _regression(
        self,
        photo: PhotoKey,
        weights: str | None,
        lens: tuple[int, int, float, float, float, float],
        pose: tuple[float, ...],
    ) -> Regression:
        from warpir.lighting.regression import regress
        from warpir.lighting.regressor import load_regressor

        camera = Camera(*lens, np.reshape(pose, (4, 4)))
        network = load_regressor(None if weights is None else Path(weights))
        return regress(network, self._read(*photo).exposed()[0], camera)


def _key(asked: InputConfig, limits: Limits) -> PhotoKey:
    """Return what says which photo it is, and how it is read."""
    return replace(asked, asset=None, asset_up=None, materials=None, occluder_mask=None), limits


def _small_photo(photo: Photo, size: tuple[int, int]) -> Photo:
    def each(planes: FloatArray) -> FloatArray:
        return np.stack([_small_plane(planes[..., k], size) for k in range(3)], axis=-1)

    srgb = each(photo.srgb)
    codes = each(photo.codes) if photo.is_linear else np.round(srgb * 255.0).astype(np.uint8)
    return replace(photo, codes=codes, srgb=srgb, kind="png", icc=None, jpeg=None)


def _small_plane(plane: FloatArray, size: tuple[int, int]) -> FloatArray:
    return np.asarray(Image.fromarray(plane).resize(size, Image.Resampling.BOX))
