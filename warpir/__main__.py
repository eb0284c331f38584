"""``python -m warpir``: the commands, a line each."""

COMMANDS = {
    "insert": "put an object into a photograph, or into every frame of a sequence",
    "place": "place the object by hand, in the browser",
    "batch": "the scenes of a manifest, several at a time",
    "report": "make the page of a finished run again",
    "check_model": "does this Stable Diffusion folder work, and is it worth a guided run?",
    "evaluate": "measure light and insertions where the truth is known",
    "study": "ask people which of two composites looks like a photograph",
    "train": "train the networks that warpir ships",
}


def main() -> int:
    """Print the commands."""
    width = max(map(len, COMMANDS))
    print("warpir: put a 3D object into a photograph so that it looks as if it had stood there\n")
    for name, about in COMMANDS.items():
        print(f"  python -m warpir.{name:{width}}  {about}")
    print("\nEach answers --help. warpir-insert and warpir-place are the first two as scripts.")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
