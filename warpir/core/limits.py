"""What an input may cost: sizes beyond which a file is refused before that much is read.

Each is a flag, ``--max-`` and the field's name, whose ``--help`` is the line below the field; an
error that is raised for one names it.
"""

from dataclasses import dataclass
from pathlib import Path

from warpir.core.errors import InputError


@dataclass(frozen=True)
class Limits:
    """The limits of one run."""

    pixels: int = 64_000_000
    """Largest photo or mask that is opened [px]"""
    envmap_width: int = 16_384
    """Widest panorama that is opened [px]"""
    file_bytes: int = 2 << 30
    """Largest mesh, texture, point cloud or file of a COLMAP model that is read [byte]"""
    triangles: int = 20_000_000
    """Largest asset or proxy that is read, instances counted [triangles]"""
    texture_pixels: int = 512_000_000
    """Most pixels of all textures of the asset together [px]"""
    nodes: int = 100_000
    """Most nodes of a glTF file"""
    instances: int = 65_536
    """Most meshes that a glTF file places, each instance counted"""
    points: int = 20_000_000
    """Most points of --ground-points"""
    json_bytes: int = 16 << 20
    """Largest JSON file: configuration, camera, lobes, materials, sequence [byte]; of YAML, which
    takes longer to read, a 256th"""
    gltf_json_bytes: int = 64 << 20
    """Largest JSON of a glTF file [byte]"""
    json_values: int = 3_000_000
    """Most values in a JSON file, lists and objects counted"""
    nesting: int = 100
    """Most levels of lists and objects within each other in JSON and YAML"""
    prompt_bytes: int = 4096
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
            raise InputError(where, text, advice)


LIMITS = Limits()
