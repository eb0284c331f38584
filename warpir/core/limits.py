"""What an input may cost: sizes beyond which a file is refused before that much is read.

Each is a flag, ``--max-`` and the field's name, whose ``--help`` is the line below the field; an
error that is raised for one names it.
"""

from dataclasses import dataclass
from pathlib import Path

from warpir.core.errors import InputError
from warpir.core.options import option


@dataclass(frozen=True)
class Limits:
    """The limits of one run."""

    pixels: int = option(64_000_000, "N", expert=True, low=1)
    """Largest photo or mask that is opened [px]"""
    envmap_width: int = option(16_384, "PX", expert=True, low=1, high=2**20)
    """Widest panorama that is opened [px]"""
    file_bytes: int = option(2 << 30, "BYTES", expert=True, low=1)
    """Largest photo, mask, panorama, mesh, texture, point cloud or file of a COLMAP model that is
    read [byte]"""
    triangles: int = option(20_000_000, "N", expert=True, low=1)
    """Largest asset or proxy that is read, instances counted [triangles]"""
    texture_pixels: int = option(512_000_000, "N", expert=True, low=1)
    """Most pixels of all textures of the asset together [px]"""
    nodes: int = option(100_000, "N", expert=True, low=1)
    """Most nodes of a glTF file"""
    instances: int = option(65_536, "N", expert=True, low=1)
    """Most meshes that a glTF file places, each instance counted"""
    points: int = option(20_000_000, "N", expert=True, low=1)
    """Most points of --ground-points"""
    json_bytes: int = option(16 << 20, "BYTES", expert=True, low=1)
    """Largest JSON file: configuration, camera, lobes, materials, sequence [byte]; of YAML, which
    takes longer to read, a 256th"""
    gltf_json_bytes: int = option(64 << 20, "BYTES", expert=True, low=1)
    """Largest JSON of a glTF file [byte]"""
    json_values: int = option(3_000_000, "N", expert=True, low=1)
    """Most values in a JSON file, lists and objects counted"""
    nesting: int = option(100, "LEVELS", expert=True, low=1, high=200)
    """Most levels of lists and objects within each other in JSON and YAML"""
    prompt_bytes: int = option(4096, "BYTES", expert=True, low=1)
    """Longest prompt [byte]"""

    def check(
        self,
        name: str,
        found: int,
        where: str | Path,
        what: str,
        *,
        more: str = "",
        advice: str = "",
    ) -> None:
        """Refuse more than a limit, with both numbers and the flag that raises it.

        Args:
            name: The field.
            found: How much there is.
            where: The file.
            what: What there is too much of, such as ``too many triangles``.
            more: What the number stands for, to be added to it.
            advice: What helps beside another limit.

        Raises:
            InputError: ``found`` is more than the limit.
        """
        limit = getattr(self, name)
        if found > limit:
            flag = f"--max-{name.replace('_', '-')}"
            text = f"{what} (found {found}{more}; limit {limit}); {flag} raises it"
            raise InputError(where, text, advice, reason=f"limit.{name}", found=found, limit=limit)


LIMITS = Limits()
