"""Pictures, panoramas and meshes of others, which lie beside the repository where there are any."""

from pathlib import Path

import pytest

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"
MESHES = SHARED / "mesh"
needs_shared = pytest.mark.skipif(not SHARED.is_dir(), reason=f"no development data at {SHARED}")
