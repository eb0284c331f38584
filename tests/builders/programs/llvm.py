"""The compiler that Mitsuba's LLVM variant needs."""

import os
from pathlib import Path

LIBRARY = "DRJIT_LIBLLVM_PATH"


def llvm() -> str | None:
    """Return a library of LLVM that Mitsuba can use; 15 and older abort."""
    found = sorted(Path("/usr/lib").glob("*/libLLVM.so.2?.*"))
    return os.environ.get(LIBRARY) or (str(found[-1]) if found else None)
