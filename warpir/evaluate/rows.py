"""Rows of the evaluation: each is one way to predict the light of a scene."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from warpir.app.config import usage
from warpir.app.inputs import Inputs
from warpir.app.run import Run
from warpir.calibration.estimate import estimate_camera
from warpir.core.arrays import FloatArray
from warpir.core.color import luminance
from warpir.core.errors import InputError
from warpir.core.latlong import rotate_map
from warpir.evaluate.scenes import CAMERA_HEIGHT, Place, Subject, mirrored, turned_to
from warpir.evaluate.stage import Bench, Prediction, Stage, unseen_by
from warpir.io.images.photos import read_photo
from warpir.io.images.writers import png_bytes
from warpir.io.results import OutputFolder
from warpir.lighting.fit import fit_lobes
from warpir.lighting.regression import Regression, mean_training_light, regress
from warpir.lighting.regressor import Regressor
from warpir.lighting.scene_light import make_light
from warpir.lighting.visible_sun import with_visible_sun
from warpir.optimize.recover import recover
from warpir.scene.light import Light, Lobes, axis_from_angles, summarize
from warpir.train.validation import region_mass

ORACLE_LOBES = 64
"""Number of lobes of the oracle: as many as of the recovered light."""
BRIGHT_SIGMA = np.radians(5.0)
"""Width of the lobe in place of the brightest visible region [rad]."""
MEAN_OVER_PHOTO = 2.0
"""Mean radiance of all directions over the photo's mean; the median of 120 crops of 20 panoramas
was 2.1, because lamps and suns are seldom in the picture."""
BLUR_SHARE = 0.02
"""Standard deviation of the blur before the brightest pixel is sought, over the photo width [1]."""


@dataclass(frozen=True)
class Row:
    """One line of the tables."""

    group: str
    """A key of `GROUPS`."""
    words: str
    """Description for a reader of the tables."""
    of_place: Callable[[Bench, Place], Prediction] | None = None
    """Predicts from the photograph alone."""
    of_subject: Callable[[Bench, Stage, Subject], Prediction] | None = None
    """Predicts from the photograph and the object."""
    start: str | None = None
    """The row that it starts from and should be better than."""
    same_as: str | None = None
    """The row whose light it should give."""
    needs: tuple[str, ...] = ()
    """Some of ``regressor``, ``calibrator``, ``model`` and ``panoramas``; the last means two
    panoramas."""

    def require(self, bench: Bench) -> None:
        """Check that what the row needs is there.

        Raises:
            InputError: It is not.
        """
        if "panoramas" in self.needs:
            bench.other(bench.scenes[0][0])
        if "regressor" in self.needs:
            _ = bench.network
        if "calibrator" in self.needs:
            _ = bench.calibrator
        if "model" in self.needs:
            bench.require_guide()


GROUPS = {
    "references": "what is known of the truth",
    "baselines": "guesses that need no learning",
    "methods": "what warpir does",
    "predictions": "lights of another system (--predictions)",
    "controls": "what must fail, or flip",
    "ablations": "the authors' Table S3, each from an even light and without the acceptance test",
}
"""Description of each group of rows; a group's name stands for all of its rows."""


def uniform(bench: Bench, place: Place) -> Prediction:
    """Return an even grey light, as bright as the photograph lets one expect."""
    level = MEAN_OVER_PHOTO * float(luminance(place.photo_lin).mean())
    return Prediction.of(Light(texels=np.full((8, 16, 3), level, np.float32)))


def brightest(bench: Bench, place: Place) -> Prediction:
    """Return a light of the photograph's mean colour, half of it from its brightest region.

    As bright on the whole as `uniform`.
    """
    from scipy.ndimage import gaussian_filter

    photo, camera = place.photo_lin, place.camera
    blurred = gaussian_filter(luminance(photo), BLUR_SHARE * camera.width, mode="nearest")
    row, column = np.unravel_index(int(np.argmax(blurred)), blurred.shape)
    _, axis = camera.ray(float(column) + 0.5, float(row) + 0.5)
    half = 0.5 * MEAN_OVER_PHOTO * photo.reshape(-1, 3).mean(axis=0)
    lobes = Lobes(
        np.ones((1, 3), np.float32),
        axis[None].astype(np.float32),
        np.array([1.0 / BRIGHT_SIGMA**2], np.float32),
    )
    lobes.amplitude[:] = 4.0 * np.pi * half / lobes.flux()
    return Prediction.of(Light(lobes, np.broadcast_to(half, (8, 16, 3)).astype(np.float32)))


def mean_training(bench: Bench, place: Place) -> Prediction:
    """Return the mean light of the regressor's training, turned to the camera."""
    return Prediction.of(
        Light(lobes=mean_training_light(bench.network, place.photo, place.camera).lobes())
    )


def regression(network: Regressor, place: Place) -> Prediction:
    """Return the light that a regressor estimates, with the sun where the photograph shows it."""
    estimate = regress(network, place.photo, place.camera)
    estimate = with_visible_sun(estimate, place.photo, place.camera)
    about: dict[str, Any] = {"spread_deg": estimate.spread_deg, "sun_in_view": estimate.sun_in_view}
    if estimate.sun_in_view is None:
        about["truth_mass"] = _truth_mass(estimate, place)
    prediction = Prediction.of(Light(lobes=estimate.lobes()), **about)
    return replace(prediction, light_shadow=Light(lobes=estimate.shadow_lobes()))


def _truth_mass(estimate: Regression, place: Place) -> float:
    """Return the mass of the smallest region of directions that holds the true peak [1].

    Of calibrated answers it is below .68 in 68 % of the photographs.
    """
    peak = summarize(Light(texels=place.texels))
    axis = axis_from_angles(peak.azimuth_deg, peak.elevation_deg)
    rows = (estimate.directions, estimate.probability[None], axis[None])
    return float(region_mass(*(torch.from_numpy(np.asarray(r)) for r in rows))[0])


def regression_with_estimated_camera(bench: Bench, place: Place) -> Prediction:
    """Return the light that a regressor estimates with a camera that is estimated too.

    Only the azimuth is the true one, which no photograph tells. Panoramas that the cameras' network
    has learned from are not left out.
    """
    height, width = place.photo.shape[:2]
    found = estimate_camera(place.photo, bench.calibrator)
    camera = turned_to(found.camera(width, height, CAMERA_HEIGHT), place.azimuth)
    network = bench.network_for(place.panorama)
    return regression(network, replace(place, camera=camera))


def other_photo(bench: Bench, place: Place) -> Prediction:
    """Return the estimate from another place's photograph, as if this camera had been there."""
    other = bench.other(place)
    light = regression(bench.network_for(other.panorama), other).light
    return Prediction.of(light.rotated(other.azimuth - place.azimuth))


def mirrored_photo(bench: Bench, place: Place) -> Prediction:
    """Return the estimate from the mirrored photograph, mirrored back."""
    flipped = replace(place, photo=np.ascontiguousarray(place.photo[:, ::-1]))
    found = regression(bench.network_for(place.panorama), flipped)
    return Prediction.of(mirrored(found.light, place.azimuth))


def turned(bench: Bench, place: Place) -> Prediction:
    """Return the true light, turned by 180 degrees about the vertical."""
    return Prediction.of(Light(texels=rotate_map(place.texels, 180.0)))


def other_light(bench: Bench, place: Place) -> Prediction:
    """Return the light of another place, as if this camera had been there."""
    other = bench.other(place)
    return Prediction.of(Light(texels=place.to_world(other.to_camera(other.texels))))


def oracle(bench: Bench, place: Place) -> Prediction:
    """Return lobes that were fitted to the truth."""
    fit = fit_lobes(place.texels, ORACLE_LOBES)
    return Prediction.of(Light(lobes=fit.lobes), irradiance_error=fit.irradiance_error)


def truth(bench: Bench, stage: Stage, subject: Subject) -> Prediction:
    """Return the truth: every error must be 0."""
    return stage.true_prediction()


def noise(bench: Bench, stage: Stage, subject: Subject) -> Prediction:
    """Return the truth, rendered from other random numbers."""
    return replace(stage.true_prediction(), seed=1)


def tone_floor(bench: Bench, stage: Stage, subject: Subject) -> Prediction:
    """Return the true light, shown by the best curves after Reinhard's operator."""
    return replace(stage.true_prediction(), curves=stage.tone_floor())


def predicted(bench: Bench, place: Place) -> Prediction:
    """Return the light that another system predicted."""
    return Prediction.of(Light(texels=bench.predictions[place.name]))


def guided(**changes: Any) -> Callable[[Bench, Stage, Subject], Prediction]:
    """Return a row that runs warpir's guided recovery with some settings changed."""

    def predict(bench: Bench, stage: Stage, subject: Subject) -> Prediction:
        place = subject.place
        return recover_light(bench, subject, place.photo, place.panorama, changes)

    return predict


def guided_elsewhere(bench: Bench, stage: Stage, subject: Subject) -> Prediction:
    """Return the light that guidance recovers from another place's photograph."""
    other = bench.other(subject.place)
    start = {"start": "regressed"}
    return recover_light(bench, subject, other.photo, other.panorama, start)


def guided_mirrored(bench: Bench, stage: Stage, subject: Subject) -> Prediction:
    """Return the light recovered from mirrored photograph and object, mirrored back."""
    place, placement = subject.place, subject.placement
    right = np.array([np.cos(np.radians(place.azimuth)), 0.0, np.sin(np.radians(place.azimuth))])
    reflect = np.eye(4)
    reflect[:3, :3] -= 2.0 * np.outer(right, right)
    reflected = replace(placement, asset_to_world=reflect @ placement.asset_to_world)
    flipped = replace(subject, placement=reflected)
    photo = np.ascontiguousarray(place.photo[:, ::-1])
    start = {"start": "regressed"}
    prediction = recover_light(bench, flipped, photo, place.panorama, start)
    light = mirrored(prediction.light, place.azimuth)
    shadow = light
    if prediction.light_shadow is not prediction.light:
        shadow = mirrored(prediction.light_shadow, place.azimuth)
    return replace(prediction, light=light, light_shadow=shadow)


def recover_light(
    bench: Bench, subject: Subject, photo: FloatArray, panorama: str, changes: Mapping[str, Any]
) -> Prediction:
    """Run what `warpir.insert` runs, up to the recovered light and curves.

    The photo for guidance is display-encoded, shape [H, W, 3], and cut out of ``panorama``, from
    which the networks that start it have not learned; ``changes`` are settings that differ from the
    bench's.
    """
    place = subject.place
    with tempfile.TemporaryDirectory() as folder:
        codes = np.round(255.0 * photo).astype(np.uint8)
        path, out = Path(folder) / "photo.png", Path(folder) / "out"
        path.write_bytes(png_bytes(codes, None, False, "a crop of a panorama"))
        config = bench.config.changed(
            photo=str(path),
            asset=str(subject.asset_path),
            out=str(out),
            prompt=bench.config.guidance.prompt or f"a {_words(subject.asset_path.stem)}",
            device=bench.device,
            seed=bench.seed,
            checkpoint_every=0,
            preview_every=0,
            **changes,
        )
        inputs = Inputs(read_photo(path), subject.asset, place.camera, subject.placement)
        started = time.perf_counter()
        light, seen = make_light(inputs, config.light, config.tone_operator), None
        if light is None:
            seen = regress(bench.network_for(panorama), inputs.photo.srgb, inputs.camera)
        with OutputFolder(out) as output:
            outcome = recover(Run(config, inputs, output, device=bench.device), light, seen)
    found = outcome.light
    about = {"seconds": round(time.perf_counter() - started, 2), "record": outcome.record}
    return Prediction(found.light, found.light_shadow, found.curves, about=about)


def _words(stem: str) -> str:
    """Return a file's name as words for a prompt."""
    letters = "".join(c if c.isalpha() else " " for c in stem)
    return " ".join(letters.lower().split()) or "object"


def _ablation(words: str, **changes: Any) -> Row:
    predict = guided(start="uniform", accept=False, **changes)
    return Row("ablations", words, of_subject=predict, start="uniform", needs=("model",))


ROWS = {
    "truth": Row("references", "the true light: must be 0", of_subject=truth),
    "noise": Row(
        "references", "the true light, other samples: the renderer's noise", of_subject=noise
    ),
    "tone-floor": Row(
        "references", "the true light, Reinhard and the best curves", of_subject=tone_floor
    ),
    "oracle": Row("references", f"{ORACLE_LOBES} lobes fitted to the true light", of_place=oracle),
    "turned-180": Row("references", "the true light, turned by 180 degrees", of_place=turned),
    "other-light": Row(
        "references", "the light of another scene", of_place=other_light, needs=("panoramas",)
    ),
    "uniform": Row(
        "baselines", "an even light, as bright as the photo lets one expect", of_place=uniform
    ),
    "mean-training-light": Row(
        "baselines",
        "the mean light of the regressor's training",
        of_place=mean_training,
        needs=("regressor",),
    ),
    "brightest-region": Row(
        "baselines", "the same, half of it from the brightest visible region", of_place=brightest
    ),
    "regression": Row(
        "methods",
        "the regressor alone",
        of_place=lambda bench, place: regression(bench.network_for(place.panorama), place),
        needs=("regressor",),
    ),
    "regression-estimated-camera": Row(
        "methods",
        "the same, the camera estimated too",
        of_place=regression_with_estimated_camera,
        start="regression",
        needs=("regressor", "calibrator"),
    ),
    "lds-uniform": Row(
        "methods",
        "guidance from an even light",
        of_subject=guided(start="uniform"),
        start="uniform",
        needs=("model",),
    ),
    "lds-regression": Row(
        "methods",
        "guidance from the regressor's light",
        of_subject=guided(start="regressed"),
        start="regression",
        needs=("model", "regressor"),
    ),
    "predictions": Row("predictions", "the lights of --predictions", of_place=predicted),
    "random-regression": Row(
        "controls",
        "a regressor with random weights",
        of_place=lambda bench, place: regression(bench.random_network, place),
    ),
    "other-photo": Row(
        "controls",
        "the regressor, shown another scene",
        of_place=other_photo,
        needs=("regressor", "panoramas"),
    ),
    "mirrored": Row(
        "controls",
        "the regressor, shown the mirrored photo; its light mirrored back",
        of_place=mirrored_photo,
        same_as="regression",
        needs=("regressor",),
    ),
    "lds-other-photo": Row(
        "controls",
        "guidance in another scene's photo",
        of_subject=guided_elsewhere,
        needs=("model", "regressor", "panoramas"),
    ),
    "lds-mirrored": Row(
        "controls",
        "guidance in the mirrored photo; its light mirrored back",
        of_subject=guided_mirrored,
        same_as="lds-regression",
        needs=("model", "regressor"),
    ),
    "s3-full": _ablation("the authors' method", loss="lds"),
    "s3-dataset-update": _ablation("a picture edited again and again", loss="dataset-update"),
    "s3-sds": _ablation("score distillation, adapted model", loss="sds"),
    "s3-sds-no-lora": _ablation("the same, base model", loss="sds-base"),
    "s3-no-class-images": _ablation("no concept preservation", loss="lds", class_images=0),
    "s3-no-tone-curve": _ablation("no tone curves", loss="lds", tone_curve=False),
    "s3-no-fusion": _ablation("two lights to the end", loss="lds", fusion="none"),
    "s3-single": _ablation("one light from the start", loss="lds", fusion="single"),
    "s3-lora-both": _ablation("adapted model in both terms", loss="lds-lora-both"),
}
"""All rows by name, in the order of the tables."""
DEFAULT_ROWS = (
    *(name for name, row in ROWS.items() if row.group in ("references", "baselines", "methods")),
    *("random-regression", "other-photo", "mirrored"),
)


def chosen_rows(text: str | None, has_predictions: bool, is_guided: bool = True) -> list[str]:
    """Return the rows of a list of names and groups, in the tables' order.

    Args:
        text: Names of rows and groups, separated by commas; None: `DEFAULT_ROWS`.
        has_predictions: Whether --predictions was given; its row is then among them.
        is_guided: Whether guidance was asked for; else its rows must be named, for a plain run of
            warpir.insert does not guide either, and they take most of the time.

    Raises:
        InputError: A name is unknown.
    """
    names = {k for k in DEFAULT_ROWS if is_guided or "model" not in ROWS[k].needs}
    if text is not None:
        names = set()
        for word in (w.strip() for w in text.split(",")):
            chosen = {k for k, row in ROWS.items() if word in (k, row.group, "all")}
            if not chosen:
                known = ", ".join(dict.fromkeys((*GROUPS, *ROWS)))
                raise usage("--rows", f"no row {word!a}", f"known: all, {known}")
            names |= chosen
        if not has_predictions and text != "all" and "predictions" in names:
            raise usage("--rows", "predictions needs --predictions DIR")
    if has_predictions:
        names.add("predictions")
    else:
        names.discard("predictions")
    return [name for name in ROWS if name in names]


def usable_rows(bench: Bench, rows: Sequence[str], is_asked: bool, notices: list[str]) -> list[str]:
    """Return the usable rows; an unusable one is an error only if it was named.

    A notice names the panoramas that no network of the regressor can be judged by.

    Raises:
        InputError: A row that was asked for needs what is not there.
    """
    usable = []
    for name in rows:
        try:
            ROWS[name].require(bench)
        except InputError as error:
            if is_asked:
                raise
            notices.append(f"row {name} is left out: {error.where}: {error.what}")
        else:
            usable.append(name)
    if any("regressor" in ROWS[name].needs for name in usable):
        panoramas = sorted({place.panorama for place, _ in bench.scenes})
        known = [name for name in panoramas if unseen_by(bench.network, name) is None]
        if known:
            names = ", ".join(known)
            notices.append(
                f"all of the regressor's networks have learned from {names}: errors elsewhere are "
                "larger"
            )
    return usable
