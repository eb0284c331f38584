"""Health check of a Stable Diffusion model before a guided run.

    python -m warpir.check_model --model DIR [--photo FILE] [--prompt TEXT] [--json FILE]

`warpir.optimize.model_check` describes the checks. Ends with status 0 when all is as expected of a
trained model, with 4 when it is not, and otherwise as `warpir.insert`.
"""

import sys
from collections.abc import Sequence

from warpir.app.command import flags_of, make_parser, read_arguments, read_values
from warpir.app.config import InsertConfig, usage
from warpir.app.program import run_program, say, stay_offline
from warpir.core.errors import ExitCode

USAGE = "python -m warpir.check_model --model DIR|ID [FLAG ...]"
DESCRIPTION = "Check that a Stable Diffusion works and guides as a trained one should."
FLAGS = {
    "the check": flags_of(
        "model", "allow_download", "allow_pickle", "photo", "prompt", "device", "precision",
        "vae_precision", "vae_checkpointing", "graphs", "seed",
    )
}  # fmt: skip


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line, as `run_program`: 4 when not all is as expected."""
    return run_program(_run, argv)


def _run(arguments: list[str]) -> int:
    parser = make_parser("check_model", USAGE, DESCRIPTION, "", FLAGS)
    parser.add_argument("--json", metavar="FILE", help="Write the figures to this file too")
    texts = read_arguments(parser, arguments)
    path = texts.pop("json", None)
    config = InsertConfig(**read_values(texts))
    if config.diffusion.model is None:
        raise usage("--model", "needed", "a folder in diffusers' layout, or a hub id")

    from warpir.demo import PHOTO
    from warpir.io.images.photos import read_photo

    photo = read_photo(
        config.inputs.photo or PHOTO, max_pixels=config.limits.pixels, alpha=config.inputs.alpha
    ).srgb

    # torch, Warp and diffusers are loaded here, after everything else that can be wrong.
    if not config.diffusion.allow_download:
        stay_offline()
    from warpir.optimize.model_check import load_and_check, write_report

    report = load_and_check(config, photo, say)
    good = sum(verdict.ok for verdict in report.verdicts)
    say(f"{good} of {len(report.verdicts)} checks are as expected of a trained model")
    if path is not None:
        write_report(path, report)
    return ExitCode.DONE if report.ok else ExitCode.MODEL


if __name__ == "__main__":
    sys.exit(main())
