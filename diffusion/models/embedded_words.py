"""The words that the embedded prior knows, and how prompts become their ids.

The prompt says whether a picture is lit as its surroundings (``consistent``) or not
(``mismatched``), in what it is wrong, and what it shows where.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import groupby

import torch
from torch import Tensor
from torch.nn import functional

from warpir.diffusion.prompts import Prompts, make_prompts
from warpir.diffusion.settings import PersonalizeSettings

NOUNS = (
    "object", "car", "truck", "cow", "animal", "ball", "mug", "cup", "cake", "box", "chair",
    "table", "lamp", "tree", "statue", "toy", "building", "bottle", "vase", "teapot", "plant",
    "person", "wheel",
)  # fmt: skip
"""What is inserted; ``object`` stands for anything."""
SETTINGS = ("outdoor", "indoor", "street", "yard", "room")
WEATHERS = ("sunny", "overcast", "twilight", "night", "lamplit")
KINDS = ("consistent", "direction", "exposure", "colour", "softness", "shadow")
"""0: lit as its surroundings. The others say in what it is ``mismatched``."""
RESERVED = ("sks", "zwx", "ohwx", "xjy", "qqv", "vrk", "hjx", "kdw")
"""Never trained: a personalisation gives them a meaning."""
PAD, UNKNOWN = "<pad>", "<unk>"
VOCABULARY = (
    PAD, UNKNOWN, "consistent", "mismatched", *KINDS[1:], *NOUNS, *SETTINGS, *WEATHERS, *RESERVED,
)  # fmt: skip
VOCABULARY_SIZE = 64
"""Rows of the table of words; those beyond `VOCABULARY` are free."""
TOKEN_COUNT = 16
SYNONYMS = {
    "suv": "car", "van": "car", "automobile": "car", "sedan": "car", "taxi": "car", "cab": "car",
    "vehicle": "car", "jeep": "car", "lorry": "truck", "pickup": "truck", "bus": "truck",
    "bull": "cow", "cattle": "cow", "dog": "animal", "cat": "animal", "horse": "animal",
    "sphere": "ball", "globe": "ball", "shaderball": "ball", "football": "ball", "glass": "cup",
    "teacup": "cup", "pie": "cake", "crate": "box", "cube": "box", "carton": "box", "parcel": "box",
    "stool": "chair", "armchair": "chair", "desk": "table", "sculpture": "statue", "bust": "statue",
    "figurine": "statue", "figure": "statue", "house": "building", "tower": "building",
    "jug": "vase", "pot": "vase", "kettle": "teapot", "flower": "plant", "bush": "plant",
    "shrub": "plant", "man": "person", "woman": "person", "human": "person", "thing": "object",
    "outside": "outdoor", "outdoors": "outdoor", "inside": "indoor", "indoors": "indoor",
    "interior": "indoor", "road": "street", "garden": "yard", "sun": "sunny", "sunlight": "sunny",
    "sunlit": "sunny", "cloudy": "overcast", "clouds": "overcast", "dusk": "twilight",
    "dawn": "twilight", "sunset": "twilight", "sunrise": "twilight", "evening": "twilight",
    "lamplight": "lamplit", "color": "colour", "brightness": "exposure", "shadows": "shadow",
}  # fmt: skip
FILLERS = frozenset(
    "a an the of in on at by to with and is as its under from photo photograph picture image scene "
    "style rendering render lit light lighting".split()
)
"""Words of ordinary sentences that say nothing here."""

_IDS = {word: place for place, word in enumerate(VOCABULARY)}
_JUDGEMENTS = ("consistent", "mismatched")

DROP_ATTRIBUTE, DROP_KIND, DROP_PROMPT = 0.2, 0.3, 0.2
"""Chances that training leaves out a noun, setting or weather, a kind, or the whole prompt."""
UNKNOWN_SHARE = 0.25
"""Of the attributes that are left out, those that leave ``<unk>`` behind: an unknown word."""


def known_words(prompt: str) -> list[str]:
    """Return the words of a prompt that say something, unknown ones as ``<unk>``, in order.

    Words are lower-case, synonyms become what they stand for, a plural its singular.
    """
    words = []
    for word in re.findall(r"<unk>|[^\W_]+", prompt.lower()):
        if word in FILLERS:
            continue
        word = SYNONYMS.get(word, word)
        if word not in _IDS and word.endswith("s"):
            word = SYNONYMS.get(word[:-1], word[:-1])
        words.append(word if word in _IDS else UNKNOWN)
    return words


def tokenize(prompt: str) -> list[int]:
    """Return the `TOKEN_COUNT` ids of a prompt; longer ones are cut.

    A sentence that judges nothing asks for a consistent picture. The same word several times in a
    row counts once, as do unknown ones. No word at all is the null prompt: any picture, wrongly lit
    ones included.
    """
    words = known_words(prompt)
    if prompt.strip() and not any(judgement in words for judgement in _JUDGEMENTS):
        words.insert(0, "consistent")
    kept = [word for word, _ in groupby(words)]
    ids = [_IDS[word] for word in kept[:TOKEN_COUNT]]
    return ids + [_IDS[PAD]] * (TOKEN_COUNT - len(ids))


def training_tokens(
    noun: Tensor,
    setting: Tensor,
    weather: Tensor,
    kind: Tensor,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Return the ids of prompts such as ``mismatched direction car outdoor sunny``.

    Args:
        noun: Index into `NOUNS`, int64, shape [B]; -1, here and below: not said.
        setting: Index into `SETTINGS`, shape [B].
        weather: Index into `WEATHERS`, shape [B].
        kind: Index into `KINDS`, shape [B]; -1: mismatched, not said in what.
        generator: Leaves out words and prompts at random (`DROP_ATTRIBUTE` and so on), on the
            tensors' device; None: every word is said.

    Returns:
        int64, shape [B, `TOKEN_COUNT`].
    """
    device, count = noun.device, len(noun)
    mismatched = kind != 0
    judgement = torch.where(mismatched, _IDS["mismatched"], _IDS["consistent"])
    ids = torch.stack(
        [
            judgement,
            kind + (_IDS[KINDS[1]] - 1),
            noun + _IDS[NOUNS[0]],
            setting + _IDS[SETTINGS[0]],
            weather + _IDS[WEATHERS[0]],
        ],
        dim=1,
    )
    said = torch.stack(
        [torch.ones_like(mismatched), kind > 0, noun >= 0, setting >= 0, weather >= 0], dim=1
    )
    if generator is not None:
        u = torch.rand(count, 6, device=device, generator=generator)
        said[:, 1] &= u[:, 1] >= DROP_KIND
        dropped = u[:, 2:5] < DROP_ATTRIBUTE
        unknown = u[:, 2:5] < DROP_ATTRIBUTE * UNKNOWN_SHARE
        ids[:, 2:] = torch.where(unknown, _IDS[UNKNOWN], ids[:, 2:])
        said[:, 2:] &= ~dropped | unknown
        said &= u[:, :1] >= DROP_PROMPT
    # Words move up to where those before them are missing, as in `tokenize`.
    order = torch.argsort((~said).to(torch.int8), dim=1, stable=True)
    ids = torch.where(said, ids, _IDS[PAD]).gather(1, order)
    return functional.pad(ids, (0, TOKEN_COUNT - ids.shape[1]), value=_IDS[PAD])


@dataclass(frozen=True)
class EmbeddedPrompts(Prompts):
    """What the embedded prior is asked for in a run."""

    negative: str
    """The same picture, wrongly lit."""
    unknown: tuple[str, ...]
    """Words of the user's that the prior has never seen."""


def embedded_prompts(
    user_prompt: str, settings: PersonalizeSettings, personalized: bool = False
) -> EmbeddedPrompts:
    """Return the prompts for what the user calls the object, in words that the prior knows.

    A noun that it does not know becomes ``object``. The null prompt is the empty one.

    Args:
        user_prompt: The object in words, such as "a black SUV car".
        settings: Token, class noun, and whether the photo shows a room.
        personalized: Guidance asks for the photo's style too.

    Raises:
        ValueError: The prompt, the noun or the token has no word.
    """
    plain = make_prompts(user_prompt, settings)
    words = [*known_words(settings.class_noun or ""), *known_words(user_prompt)]
    noun = next((word for word in words if word in NOUNS), NOUNS[0])
    places = [word for word in dict.fromkeys(words) if word in SETTINGS]
    if not places and settings.indoors:
        places = ["indoor"]
    weathers = [word for word in dict.fromkeys(words) if word in WEATHERS]
    thing = " ".join([noun, *places, *weathers])
    style = f" in the style of {settings.token} rendering" if personalized else ""
    unknown = [word for word in user_prompt.split() if known_words(word) == [UNKNOWN]]
    return EmbeddedPrompts(
        photo=plain.photo,
        class_=f"consistent {noun}",
        guidance=f"consistent {thing}{style}",
        noun=noun,
        negative=f"mismatched {thing}{style}",
        unknown=tuple(dict.fromkeys(unknown)),
    )
