"""All that is repeated on the object of what the camera did to the scene."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from warpir.core.arrays import AnyFloatArray, BoolArray, Float64Array, FloatArray, in_bands
from warpir.core.color import GAMMA, luminance
from warpir.io.images.jpeg import JpegCoding
from warpir.io.images.photos import Photo
from warpir.look.grain import Grain, as_told, blocks_over, estimate_grain, grain_over
from warpir.look.response import PLACED, Response, estimate_response
from warpir.look.sharpness import PIXEL_SIGMA, EdgeBlur, blurred_layers, estimate_blur
from warpir.look.texture import read_texture
from warpir.look.toning import Toning, toning_of

UPSAMPLED = 2.5
"""Variance of a rendered edge that was enlarged bilinearly, over that of its own pixel [1]."""
DOWNSAMPLED = 2.0
"""Variance of the tent by which a larger rendering is averaged, over that of a pixel [1]."""
FAINT = 1e-4
"""Coverage and darkening below which the blurred object and shadow end [1]."""
SUMMED = ("foreground", "diffuse", "specular", "emission")
"""Premultiplied planes of the object."""


@dataclass(frozen=True)
class CameraLook:
    """Blur, response, grain and JPEG blocks of a photo, where they are repeated on the object."""

    blur: EdgeBlur | None = None
    """Of the lens, given or estimated."""
    grain: Grain | None = None
    response: Response | None = None
    jpeg: JpegCoding | None = None
    toning: Toning | None = None
    """Of a black and white photo, which the object shares."""
    frame: str | None = None
    """Frame of a sequence whose photo told what is estimated but the JPEG coding; None: the photo
    itself."""

    def blur_to_add(self, enlarged: float = 1.0) -> float:
        """Return the Gaussian that a rendered object lacks [px].

        Args:
            enlarged: Width of the photo over that of the rendering [1].
        """
        if self.blur is None:
            return 0.0
        own = PIXEL_SIGMA**2
        if enlarged > 1.0:
            own *= UPSAMPLED * enlarged**2
        elif enlarged < 1.0:
            own *= DOWNSAMPLED + enlarged**2
        return float(np.sqrt(max(self.blur.sigma**2 - own, 0.0)))

    def sharpened_like_photo(
        self, planes: dict[str, FloatArray], enlarged: float = 1.0
    ) -> dict[str, FloatArray]:
        """Return the planes of `blurred_layers` behind the photo's blur; nothing is sharpened."""
        sigma = self.blur_to_add(enlarged)
        if sigma < 0.05:
            return planes
        blurred = blurred_layers(planes, sigma, SUMMED)
        faint = blurred["matte"] < FAINT
        for name in (*SUMMED, "matte"):
            blurred[name][faint] = 0.0
        unshaded = np.abs(blurred["shadow_ratio"] - 1.0) < FAINT
        blurred["shadow_ratio"][unshaded] = 1.0
        return blurred

    def shown_like_photo(
        self, planes: dict[str, FloatArray], plate: FloatArray
    ) -> dict[str, FloatArray]:
        """Return the planes behind the photo's response; parts keep their share of the object.

        Args:
            planes: Those of `blurred_layers`.
            plate: Display-linear photo, shape [H, W, 3].
        """
        response = self.response
        if response is None:
            return planes
        changed = (*SUMMED, "shadow_ratio")
        planes = planes | {name: planes[name].copy() for name in changed}

        def show(rows: slice) -> None:
            band = {name: planes[name][rows] for name in (*changed, "matte")}
            self._show(response, band, plate[rows])

        in_bands(show, *plate.shape[:2])
        return planes

    @staticmethod
    def _show(response: Response, planes: dict[str, FloatArray], plate: FloatArray) -> None:
        """Put planes behind the response, in place."""
        seen = planes["matte"] > 0.0
        coverage = planes["matte"][seen][:, None]
        before = planes["foreground"][seen]
        after = response.colour(before / coverage) * coverage
        share = after / np.maximum(before, 1e-30)
        for name in ("diffuse", "specular", "emission"):
            planes[name][seen] *= share
        planes["foreground"][seen] = after
        shaded = (planes["shadow_ratio"] != 1.0).any(axis=-1)
        ratio = planes["shadow_ratio"][shaded]
        bent = response.shadow_ratio(ratio, plate[shaded])
        planes["shadow_ratio"][shaded] = np.where(ratio == 1.0, ratio, bent)

    def coloured_like_photo(
        self, planes: dict[str, FloatArray], plate: FloatArray
    ) -> dict[str, FloatArray]:
        """Return the planes of `shown_like_photo`, and ``mirror``, toned if the photo is."""
        toning = self.toning
        if toning is None:
            return planes
        if toning.is_grey:
            names = {*SUMMED, "shadow_ratio", "mirror"} & planes.keys()
            return planes | {name: _as_grey(planes[name]) for name in names}
        toned = planes | {name: planes[name].copy() for name in SUMMED}
        parts = [toned[name] for name in SUMMED if name != "foreground"]
        toning.on_object(toned["foreground"], parts, toned["matte"])
        toned["shadow_ratio"] = toning.on_ground(planes["shadow_ratio"], plate)
        if "mirror" in planes:
            shaded = plate * toned["shadow_ratio"]
            toned["mirror"] = toning.on_mirror(planes["mirror"], shaded)
        return toned

    def grain_on(
        self,
        composite: FloatArray,
        plate: FloatArray,
        matte: FloatArray,
        changed: BoolArray,
        seed: int,
        gamma: float,
    ) -> FloatArray | None:
        """Return what `grain_over` and then `blocks_over` add; None without both."""
        added, grain = None, self.grain
        if grain is not None:
            if self.toning is not None:  # the mean of channels that differ would be weaker
                grain = replace(grain, correlation=1.0)
            added = grain_over(grain, composite, plate, matte, changed, seed, gamma)
            composite = composite + added
        if self.jpeg is not None:
            blocks = blocks_over(self.jpeg, composite, changed, gamma)
            added = blocks if added is None else added + blocks
        return _as_grey(added) if self.toning is not None and added is not None else added

    def lines(self) -> list[str]:
        """Return what was estimated, a sentence each."""
        found = []
        if self.toning is not None:
            words = "black and white" if self.toning.is_grey else "toned black and white"
            found.append(f"the photo is {words}, and so is the object (--response off: not)")
        if self.response is not None:
            black = 255.0 * self.response.dark(np.array(PLACED[0])) ** (1.0 / GAMMA)
            found.append(
                f"the camera has the contrast {self.response.exponent:.2f} and the toe "
                f"{self.response.toe:.4f} on top of gamma 2.2, so that the object's blacks of "
                f"{PLACED[0]} are shown as code {black:.0f}, not 18 (--response)"
            )
        if self.blur is not None:
            found.append(
                f"the photo is blurred by {self.blur.sigma:.2f} px, and so is "
                "the object (--sharpness)"
            )
        if self.grain is not None:
            found.append(
                f"the photo has grain of {255.0 * self.grain.typical:.1f} codes of 255, and so "
                "has the object (--grain)"
            )
        if self.jpeg is not None:
            found.append(
                f"the photo is a JPEG of quality {self.jpeg.quality}, and so are the object and "
                "the ground that it changes (--grain)"
            )
        if self.frame is not None and (self.blur or self.grain or self.response):
            found.append(
                f"contrast, blur and grain are those of frame {self.frame}, for all frames of its "
                "size: one camera took them (--response, --sharpness, --grain)"
            )
        return found

    def record(self) -> dict[str, Any]:
        """Return what ``run.json`` holds: pixels, and display values in [0, 1]."""
        return {
            "blur": None if self.blur is None else asdict(self.blur),
            "grain": None if self.grain is None else asdict(self.grain),
            **({} if self.response is None else {"response": asdict(self.response)}),
            **({} if self.jpeg is None else {"jpeg": {"quality": self.jpeg.quality}}),
            **({} if self.toning is None else {"toning": asdict(self.toning)}),
            **({} if self.frame is None else {"frame": self.frame}),
        }


def look_of_preview(photo: Photo, response: float | str) -> CameraLook:
    """Return what a preview has of a photo's look: its toning, where it is black and white.

    ``response`` is that of `estimate_look`; ``off`` leaves colours.
    """
    return CameraLook(toning=None if response == "off" else toning_of(photo))


def _as_grey(plane: FloatArray) -> FloatArray:
    """Return a plane's luminance in all channels; what is grey stays to the bit; [H, W, 3]."""
    grey = np.asarray(luminance(plane), np.float32)[..., None]
    return np.where((plane == plane[..., :1]).all(axis=-1, keepdims=True), plane, grey)


def estimate_look(
    srgb: AnyFloatArray,
    linear: AnyFloatArray,
    region: BoolArray | None = None,
    sharpness: float | str = "auto",
    grain: float | str = "auto",
    response: float | str = "off",
    jpeg: JpegCoding | None = None,
) -> CameraLook:
    """Estimate what a camera did to a photo.

    Args:
        srgb: Display-encoded photo, shape [H, W, 3].
        linear: The same display-linear.
        region: Where the object will stand; what surrounds it is looked at first, shape [H, W].
        sharpness: ``auto``, ``off``, or the standard deviation of the blur [px].
        grain: ``auto``, ``off`` (then without the blocks too), or its standard deviation [codes of
            255].
        response: ``auto``, ``off``, or the exponent of its contrast [1].
        jpeg: How the photo's file was coded, or None.
    """
    look = CameraLook(jpeg=None if grain == "off" else jpeg)
    with ThreadPoolExecutor(2) as pool:
        if "auto" in (sharpness, grain):
            texture = pool.submit(read_texture, linear, region)
        if sharpness == "auto":
            blur = pool.submit(estimate_blur, linear, region, texture.result)
        if grain == "auto":
            flat, told = estimate_grain(srgb), texture.result().grain
            is_grey = bool((srgb == srgb[..., :1]).all())
            own = flat if told is None else as_told(flat, told, is_grey, jpeg is not None)
            look = replace(look, grain=own)
    if sharpness == "auto":
        look = replace(look, blur=blur.result())
    elif sharpness != "off":
        look = replace(look, blur=EdgeBlur(float(sharpness), 0))
    if grain not in ("auto", "off"):
        strength = float(grain) / 255.0
        look = replace(look, grain=Grain((0.5,), ((strength,) * 3,), 0.0, 0.0))
    if response == "auto":
        look = replace(look, response=estimate_response(linear))
    elif response != "off":
        look = replace(look, response=Response(float(response)))
    return look


def region_around(points: Float64Array, height: int, width: int) -> BoolArray:
    """Return the pixels of the box round some points, three times as wide and high.

    Args:
        points: Image positions [px]; those behind the camera are NaN; shape [N, 2].
        height: Of the photo [px].
        width: Of the photo [px].
    """
    region = np.zeros((height, width), bool)
    seen = points[np.isfinite(points).all(axis=1)]
    if len(seen) == 0:
        return ~region
    low, high = seen.min(axis=0), seen.max(axis=0)
    limit = np.array([width, height])
    first = np.clip(2.0 * low - high, 0, limit).astype(int)
    last = np.ceil(np.clip(2.0 * high - low, 0, limit)).astype(int)
    region[first[1] : last[1], first[0] : last[0]] = True
    return region
