"""Former names of modules: scripts written before the rooms keep working.

``from warpir.config import InsertConfig`` finds `warpir.app.config`; both names are one module.
Only modules that documents showed are listed.
"""

import sys
from importlib import import_module
from importlib.abc import Loader
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import cast

MOVED = {
    "asset": "scene.asset",
    "caches": "core.cache",
    "camera": "scene.camera",
    "color": "core.color",
    "config": "app.config",
    "curves": "scene.tone_curves",
    "files": "io.layers",
    "fusion": "lighting.fusion",
    "inputs": "app.inputs",
    "integrator": "render.integrator",
    "light": "scene.light",
    "lobe_fit": "lighting.fit",
    "photo_files": "io.images.photos",
    "picture": "render.picture.photo_scene",
    "sg_light": "lighting.sg_light",
    "tone": "render.tone_curve",
    "transport": "render.transport.integrator",
    "transport_rows": "render.transport.rows",
    "view": "optimize.view",
}


class MovedModules:
    """Finds a module under its former name and hands out the module itself."""

    @classmethod
    def find_spec(cls, name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        """Return how to load ``warpir.config``; None for every other module."""
        package, _, leaf = name.partition(".")
        loads = package == "warpir" and leaf in MOVED
        return ModuleSpec(name, cast(Loader, cls())) if loads else None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """Import the module by its present name."""
        module = import_module("warpir." + MOVED[spec.name.removeprefix("warpir.")])
        spec.loader_state = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        """Leave the module as it is, its own spec included."""
        assert module.__spec__ is not None
        module.__spec__ = module.__spec__.loader_state


def find_moved_modules() -> None:
    """Let ``import`` look here after everywhere else; once is enough."""
    if not any(finder is MovedModules for finder in sys.meta_path):
        sys.meta_path.append(MovedModules)
