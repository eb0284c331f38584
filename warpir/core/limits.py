"""What an input may cost: sizes beyond which a file is refused before that much is read.

Each is a flag, ``--max-`` and the field's name; an error that is raised for one names it.
"""

from dataclasses import dataclass
from pathlib import Path

from warpir.core.errors import InputError


@dataclass(frozen=True)
class Limits:
    """The limits of one run."""

    pixels: int = 64_000_000
    """Of the photo and its masks, each [px]."""
    envmap_width: int = 16_384
    """Of a panorama [px]."""
    file_bytes: int = 2 << 30
    """Of a mesh, a texture, a point cloud or a file of a COLMAP model [byte]."""
    triangles: int = 20_000_000
    """Of an asset or a proxy, instances counted; vertices may be three times as many."""
    texture_pixels: int = 512_000_000
    """Of all textures of an asset together [px]."""
    nodes: int = 100_000
    """Of a glTF file."""
    instances: int = 65_536
    """Of placed primitives of a glTF file."""
    points: int = 20_000_000
    """Of a point cloud."""
    json_bytes: int = 16 << 20
    """Of a configuration, a camera, lobes, a sequence or another JSON file [byte]."""
    gltf_json_bytes: int = 64 << 20
    """Of the JSON of a glTF file [byte]."""
    json_values: int = 3_000_000
    """Of JSON: objects, lists and what they hold."""
    nesting: int = 100
    """Levels of lists and objects within each other in JSON and YAML."""

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
