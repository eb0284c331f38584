"""What the model is asked for, before, during and after it is adapted to a photo.

Wording of DiPIR (Liang et al. 2024, section 4.2.1). The attributes of the class prompts are of the
kinds that the authors name (colour, background, lighting, size); the words are ours. Importable
without torch, so that a prompt is checked before anything is loaded.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from warpir.diffusion.settings import PersonalizeSettings

SIZES = ("tiny", "small", "compact", "medium-sized", "large", "huge", "long", "tall", "wide", "low")
COLOURS = (
    "red", "orange", "yellow", "green", "blue", "purple", "brown", "black", "white", "grey",
    "beige", "silver",
)  # fmt: skip
BACKGROUNDS = (
    "on a city street", "in a forest", "on a beach", "in a desert", "in the snow",
    "in front of a brick wall", "in an empty room", "in a garden", "on a wet road",
    "on a wooden floor", "in the mountains", "in a parking lot",
)  # fmt: skip
LIGHTINGS = (
    "in bright sunlight", "under an overcast sky", "at sunset", "at sunrise", "at night",
    "in soft morning light", "in harsh noon light", "with strong shadows", "lit from behind",
    "under street lamps",
)  # fmt: skip

_AN_BEFORE_CONSONANT = re.compile(r"hour|honest|honou?r|heir", re.IGNORECASE)
_A_BEFORE_VOWEL = re.compile(r"one\b|once\b|uni(?!m|n)|us[aeiu]|ut[ei]|eu|ewe", re.IGNORECASE)


@dataclass(frozen=True)
class Prompts:
    """The three prompts of a run."""

    photo: str
    """What the photo is called while the model learns it."""
    class_: str
    """What an object of the class is called, apart from the photo."""
    guidance: str
    """What the composite is to be."""
    noun: str
    """What the class is called in a word or two."""


def with_article(phrase: str) -> str:
    """Put ``a`` or ``an`` before a phrase by the sound that its first word is likely to have."""
    first = phrase.split(maxsplit=1)[0]
    if len(first) > 1 and first.isupper() and first.isalpha():
        an = first[0] in "AEFHILMNORSX"  # letters are spelt out: an SUV
    elif first[0].lower() in "aeiou":
        an = not _A_BEFORE_VOWEL.match(first)
    else:
        an = bool(_AN_BEFORE_CONSONANT.match(first))
    return f"{'an' if an else 'a'} {phrase}"


def _split(text: str, name: str) -> tuple[str, str]:
    """Return the article (or nothing) and the phrase of what a user wrote."""
    words = text.strip(" \t\r\n.,;:!?").split()
    article = words[0].lower() if words and words[0].lower() in ("a", "an", "the") else ""
    phrase = " ".join(words[1:] if article else words)
    if not phrase:
        raise ValueError(f"{name}: empty (found {text!r}; expected words such as 'a red car')")
    return article, phrase


def make_prompts(prompt: str, settings: PersonalizeSettings) -> Prompts:
    """Return the prompts for what the user calls the object.

    Args:
        prompt: The object in words, such as "a black SUV car".
        settings: Gives the token, and the class noun where it is not the prompt's last word.

    Raises:
        ValueError: The prompt, the noun or the token has no word; begins with the field's name.
    """
    article, phrase = _split(prompt, "prompt")
    # The user's own article is right about sounds that spelling hides.
    named = f"{article} {phrase}" if article in ("a", "an") else with_article(phrase)
    noun = _split(settings.class_noun or phrase.split()[-1], "class_noun")[1]
    photo = f"a scene in the style of {_split(settings.token, 'token')[1]} rendering"
    return Prompts(
        photo, f"a photo of {with_article(noun)}", f"a photo of {named} in {photo}", noun
    )


def draw_class_prompts(noun: str, count: int, seed: int) -> tuple[str, ...]:
    """Return class prompts with random attributes; a longer list begins as a shorter one."""
    import torch

    from warpir.diffusion.draws import generator_of

    prompts = []
    for index in range(count):
        random = generator_of(seed, "class prompt", index)
        size, colour, background, lighting = (
            words[int(torch.randint(len(words), (), generator=random))]
            for words in (SIZES, COLOURS, BACKGROUNDS, LIGHTINGS)
        )
        thing = with_article(f"{size} {colour} {noun}")
        prompts.append(f"a photo of {thing} {background}, {lighting}")
    return tuple(prompts)
