"""What looks right: diffusion priors and the guidance they give."""

if __name__ != "warpir.diffusion":
    raise ImportError("this folder is the package warpir.diffusion; import it by that name")

import importlib.util
import sys
from pathlib import Path

# transformers and diffusers import whatever is called `kernels`, for Hugging Face's package of that
# name. Started from a checkout they would find our folder and fail: None says "not installed".
_spec = importlib.util.find_spec("kernels")
if _spec and _spec.origin == str(Path(__file__).resolve().parent.parent / "kernels/__init__.py"):
    sys.modules["kernels"] = None  # type: ignore[assignment]
