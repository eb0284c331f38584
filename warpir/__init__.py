"""warpir: put a 3D object into a photograph so that it looks as if it had stood there.

Conventions, one for the whole project:

* World right-handed, +Y up, metres; a camera looks along its own -Z with +Y up (glTF).
* Images are indexed [y, x] with y down; pixel (column j, row i) has its centre at
  (j + 0.5, i + 0.5).
* Environment maps are OpenEXR lat-long: image centre = +Z, left quarter = +X, texel centres at
  +0.5; what a level camera sees lies at the map's left and right edge.
* Radiance is linear Rec.709, relative [W/(m^2 sr)]; display values are linear^(1/2.2).
* ``wo`` points toward the camera, ``wi`` toward the light.
* Angles are degrees at the command line and in files, radians inside.

The rooms, each of which imports only those of lines before it (tests/test_layers.py):

    core         errors, limits, colour, files
    scene        records of what is in the picture
    io           every byte in or out
    look         what the camera did to the photo, done to the object
    app          what was asked, checked once
    demo         the scene that ships with warpir
    render       Warp: radiance, shadow ratio, composite; calibration: the camera of a photo
    lighting     where a light comes from
    optimize     the guided loop; report: the page of a run
    sequence, place, mitsuba, train     one tool each
    insert       a run: read, light, guide, render, write
    batch, evaluate, study, check_model     commands above it

`warpir.kernels` holds the device code and knows no room; `warpir.diffusion` the priors and their
losses, which know the core alone.
"""

import importlib.util
import sys

from warpir.core.moved import find_moved_modules

__version__ = "0.1.0"

if importlib.util.find_spec("warpir.diffusion") is None:
    # The checkout's own folder, found before the installed package: an install maps kernels/ and
    # diffusion/ into it.
    _what = (
        f"warpir: {__path__[0]} is the checkout, not the installed package; run from another "
        "folder, or install it with pip install -e ."
    )
    if sys.argv[0] != "-m":  # which Python sets while it looks for what `python -m` names
        raise ImportError(_what)
    print(f"error: {_what}", file=sys.stderr)
    raise SystemExit(2)

find_moved_modules()
