"""Class images and prompts: worded well, made once, found again, whatever the batch."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image
from torch import Tensor

import warpir.diffusion.personalization.class_images as module
from tests.builders.tiny_stable_diffusion import make_tiny_stable_diffusion
from warpir.diffusion.cache import content_key, model_key
from warpir.diffusion.models.loading import load_stable_diffusion
from warpir.diffusion.models.stable_diffusion import StableDiffusion
from warpir.diffusion.personalization.class_images import (
    class_image_count,
    encode_pictures,
    make_class_images,
)
from warpir.diffusion.prior import NonFiniteError
from warpir.diffusion.prompts import (
    BACKGROUNDS,
    COLOURS,
    LIGHTINGS,
    SIZES,
    draw_class_prompts,
    make_prompts,
)
from warpir.diffusion.schedule import NoiseSchedule
from warpir.diffusion.settings import ModelSettings, PersonalizeSettings

pytestmark = pytest.mark.usefixtures("one_thread")

SETTINGS = PersonalizeSettings(class_images=5, class_steps=3, class_batch=2)
PROMPTS = make_prompts("a black SUV car", SETTINGS)


@pytest.fixture(scope="module")
def prior(tmp_path_factory: pytest.TempPathFactory) -> StableDiffusion:
    folder = make_tiny_stable_diffusion(tmp_path_factory.mktemp("sd"))
    return load_stable_diffusion(ModelSettings(model=str(folder)), "cpu")


class Painter:
    """Stands for a model: a picture is a function of prompt and seed; all calls are kept."""

    name, digest, resolution, precision = "painter", "0" * 64, 16, {"unet": "fp32"}
    device = torch.device("cpu")
    schedule = NoiseSchedule(torch.linspace(0.99, 0.01, 10, dtype=torch.float64), "epsilon")

    finite = StableDiffusion.finite

    def __init__(self, stop_after: int = 1000) -> None:
        self.batches: list[int] = []
        self.stop_after = stop_after

    def sample(self, prompts: Any, seeds: Any, *, steps: int, scale: float, batch: int) -> Tensor:
        if sum(self.batches) + len(prompts) > self.stop_after:
            raise KeyboardInterrupt
        self.batches.append(len(prompts))
        key = [content_key(p, s, steps, scale) for p, s in zip(prompts, seeds, strict=True)]
        random = [torch.Generator().manual_seed(int(k[:12], 16)) for k in key]
        return torch.stack([torch.rand(3, 16, 16, generator=g) for g in random])

    def upcast(self, what: str) -> bool:
        return False


# Prompts


@pytest.mark.parametrize(
    ("prompt", "noun", "photo_of", "class_of"),
    [
        ("a black SUV car", None, "a black SUV car", "a car"),
        ("black SUV car", None, "a black SUV car", "a car"),
        ("an orange car", None, "an orange car", "a car"),
        ("orange car", None, "an orange car", "a car"),
        ("The old  umbrella.", None, "an old umbrella", "an umbrella"),
        ("an SUV", None, "an SUV", "an SUV"),
        ("SUV", None, "an SUV", "an SUV"),
        ("UFO", None, "a UFO", "a UFO"),
        ("unicycle", None, "a unicycle", "a unicycle"),
        ("a used bicycle", "vehicle", "a used bicycle", "a vehicle"),
        ("European hourglass", "an hourglass", "a European hourglass", "an hourglass"),
        ("mug on a table", "mug", "a mug on a table", "a mug"),
    ],
)
def test_prompts(prompt: str, noun: str | None, photo_of: str, class_of: str) -> None:
    """The authors' wording, with the article that belongs to the word."""
    made = make_prompts(prompt, PersonalizeSettings(token="zwx", class_noun=noun))
    assert made.photo == "a scene in the style of zwx rendering"
    assert made.class_ == f"a photo of {class_of}"
    assert made.guidance == f"a photo of {photo_of} in a scene in the style of zwx rendering"


@pytest.mark.parametrize(("prompt", "noun"), [("", None), ("  ", None), ("an", None), ("car", "a")])
def test_empty_prompts_are_refused(prompt: str, noun: str | None) -> None:
    with pytest.raises(ValueError, match="empty"):
        make_prompts(prompt, PersonalizeSettings(class_noun=noun))


def test_class_prompts_vary_in_the_four_attributes() -> None:
    """8 to 12 words a kind, all drawn; a longer list begins as a shorter one."""
    kinds = (SIZES, COLOURS, BACKGROUNDS, LIGHTINGS)
    assert all(8 <= len(words) == len(set(words)) <= 12 for words in kinds)
    texts = draw_class_prompts("car", 200, seed=0)
    for words in kinds:
        assert all(sum(w in text for text in texts) > 0 for w in words)
    assert all(text.startswith(("a photo of a ", "a photo of an ")) for text in texts)
    assert all(" car " in text for text in texts)
    assert len(set(texts)) > 190
    assert draw_class_prompts("car", 40, seed=0) == texts[:40]
    assert draw_class_prompts("car", 40, seed=1) != texts[:40]


@pytest.mark.parametrize(
    ("count", "indoors", "expected"),
    [(None, False, 200), (None, True, 40), (7, True, 7), (0, 0, 0)],
)
def test_number_of_class_images(count: int | None, indoors: bool, expected: int) -> None:
    settings = PersonalizeSettings(class_images=count, indoors=bool(indoors))
    assert class_image_count(settings) == expected


# Making and keeping


def test_images_are_made_once(prior: StableDiffusion, tmp_path: Path) -> None:
    """By the model itself, in batches; a second run makes none and has the same."""
    told: list[tuple[str, int, int]] = []
    first = make_class_images(
        prior, PROMPTS, SETTINGS, 0, tmp_path, lambda *state: told.append(state)
    )
    assert first.images.shape == (5, 3, 64, 64)
    assert first.images.dtype == torch.uint8
    assert first.made == 5
    assert told == [("class images", done, 5) for done in (0, 2, 4, 5)]
    assert first.images.float().std() > 5.0
    again = make_class_images(prior, PROMPTS, SETTINGS, 0, tmp_path)
    assert (again.made, again.prompts, again.seeds) == (0, first.prompts, first.seeds)
    assert torch.equal(again.images, first.images)
    assert len(list(tmp_path.iterdir())) == 5


def test_images_are_the_unadapted_models(prior: StableDiffusion, tmp_path: Path) -> None:
    """Each is what the model makes of its prompt and seed alone, whatever the batch."""
    made = make_class_images(prior, PROMPTS, SETTINGS, 0, None)
    for index in (0, 3):
        alone = prior.sample(
            [made.prompts[index]], [made.seeds[index]], steps=3, scale=SETTINGS.class_scale
        )
        difference = made.images[index].float() - alone[0] * 255.0
        assert difference.abs().max() <= 0.51
    other = make_class_images(prior, PROMPTS, replace(SETTINGS, class_batch=5), 0, tmp_path)
    assert (other.images.int() - made.images.int()).abs().max() <= 1


def test_a_stopped_run_goes_on_with_the_rest(tmp_path: Path) -> None:
    whole = make_class_images(Painter(), PROMPTS, SETTINGS, 0, None)
    with pytest.raises(KeyboardInterrupt):
        make_class_images(Painter(stop_after=3), PROMPTS, SETTINGS, 0, tmp_path)
    assert len(list(tmp_path.iterdir())) == 2
    painter = Painter()
    rest = make_class_images(painter, PROMPTS, SETTINGS, 0, tmp_path)
    assert painter.batches == [2, 1]
    assert rest.made == 3
    assert torch.equal(rest.images, whole.images)
    more = make_class_images(painter, PROMPTS, replace(SETTINGS, class_images=7), 0, tmp_path)
    assert more.made == 2
    assert torch.equal(more.images[:5], whole.images)


def test_a_lost_picture_is_made_in_its_own_batch(tmp_path: Path) -> None:
    """Arithmetic depends on the batch by a bit, and a resumed run must not."""
    painter = Painter()
    whole = make_class_images(painter, PROMPTS, SETTINGS, 0, tmp_path)
    for file in tmp_path.iterdir():
        with Image.open(file) as picture:
            is_lost = int(picture.info["seed"]) == whole.seeds[3]
        if is_lost:
            file.unlink()
    painter.batches.clear()
    again = make_class_images(painter, PROMPTS, SETTINGS, 0, tmp_path)
    assert painter.batches == [2] and again.made == 1
    assert torch.equal(again.images, whole.images)


@pytest.mark.parametrize("change", ["steps", "scale", "seed", "noun", "digest", "kind", "side"])
def test_what_an_image_depends_on_is_in_its_key(tmp_path: Path, change: str) -> None:
    """Another sampler, seed, noun or model finds nothing."""
    make_class_images(Painter(), PROMPTS, SETTINGS, 0, tmp_path)
    painter, prompts, settings, seed = Painter(), PROMPTS, SETTINGS, 0
    if change == "steps":
        settings = replace(settings, class_steps=4)
    elif change == "scale":
        settings = replace(settings, class_scale=5.0)
    elif change == "seed":
        seed = 1
    elif change == "noun":
        prompts = make_prompts("a mug", settings)
    elif change == "digest":
        painter.digest = "1" * 64
    elif change == "kind":
        painter.schedule = replace(Painter.schedule, prediction_type="v_prediction")
    else:
        before = model_key(painter)
        painter.resolution = 32
        assert model_key(painter) != before
        return
    assert make_class_images(painter, prompts, settings, seed, tmp_path).made == 5
    assert make_class_images(Painter(), PROMPTS, SETTINGS, 0, tmp_path).made == 0


def test_a_batch_size_is_not_in_the_key(tmp_path: Path) -> None:
    make_class_images(Painter(), PROMPTS, SETTINGS, 0, tmp_path)
    other = replace(SETTINGS, class_batch=5, lora_steps=3)
    assert make_class_images(Painter(), PROMPTS, other, 0, tmp_path).made == 0


@pytest.mark.parametrize(
    "fault", ["empty", "cut", "junk", "flipped", "other size", "other picture"]
)
def test_a_damaged_file_is_made_again(tmp_path: Path, fault: str) -> None:
    """With a notice that names it; a flipped bit that decoders forgive counts too."""
    whole = make_class_images(Painter(), PROMPTS, SETTINGS, 0, tmp_path)
    file = sorted(tmp_path.iterdir())[2]
    content = file.read_bytes()
    flipped = bytearray(content)
    flipped[content.index(b"IDAT") + 100] ^= 1
    contents = {"cut": content[: len(content) // 2], "flipped": flipped}
    contents |= {"empty": b"", "junk": b"junk" * 100}
    if fault in contents:
        file.write_bytes(contents[fault])
    else:
        side = 8 if fault == "other size" else 16
        Image.new("RGB", (side, side)).save(file)
    again = make_class_images(Painter(), PROMPTS, SETTINGS, 0, tmp_path)
    assert again.made == 1
    assert len(again.notices) == 1
    assert str(file) in again.notices[0]
    assert torch.equal(again.images, whole.images)
    assert make_class_images(Painter(), PROMPTS, SETTINGS, 0, tmp_path).made == 0


def test_files_say_what_they_show(tmp_path: Path) -> None:
    made = make_class_images(Painter(), PROMPTS, SETTINGS, 0, tmp_path)
    found = set()
    for file in tmp_path.iterdir():
        with Image.open(file) as picture:
            found.add((picture.info["prompt"], int(picture.info["seed"])))
    assert found == set(zip(made.prompts, made.seeds, strict=True))


def test_a_full_disk_is_only_a_notice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, content: bytes) -> None:
        raise OSError("No space left on device")

    monkeypatch.setattr(module, "write_file", full)
    made = make_class_images(Painter(), PROMPTS, SETTINGS, 0, tmp_path)
    assert made.made == 5
    assert len(made.notices) == 1
    assert "not kept" in made.notices[0]


def test_none_are_made_for_the_ablation(tmp_path: Path) -> None:
    painter = Painter()
    made = make_class_images(painter, PROMPTS, replace(SETTINGS, class_images=0), 0, tmp_path)
    assert made.images.shape == (0, 3, 16, 16)
    assert painter.batches == []


def test_pictures_that_are_not_finite_are_refused(tmp_path: Path) -> None:
    """Half precision overflows to black pictures; none is kept."""
    painter = Painter()
    painter.sample = lambda *a, **k: torch.full((2, 3, 16, 16), float("nan"))  # type: ignore[method-assign]
    with pytest.raises(NonFiniteError, match="not finite"):
        make_class_images(painter, PROMPTS, SETTINGS, 0, tmp_path)
    assert not list(tmp_path.iterdir())


def test_latents_are_the_encoded_images(prior: StableDiffusion) -> None:
    images = torch.randint(256, (3, 3, 64, 64), dtype=torch.uint8)
    latents = encode_pictures(prior, images, batch=2)
    expected = torch.cat([prior.encode(image[None].float() / 255.0) for image in images])
    assert not latents.requires_grad
    torch.testing.assert_close(latents, expected.detach(), rtol=1e-4, atol=1e-5)


# The cache


def test_keys_tell_contents_apart() -> None:
    ones = torch.ones(2, 3)
    others = [ones.double(), ones.T, ones * 2, "1", 1, (1,), None]
    keys = {content_key(other) for other in [ones, *others]}
    assert len(keys) == 1 + len(others)
    assert content_key(ones) == content_key(torch.ones(2, 3))
    assert content_key("a", "b") != content_key("ab")
