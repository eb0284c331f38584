"""Lamps of the placing page: its plain values in the ground frame, and the saved file.

The page has them as the rows of ``--lamps`` (`warpir.io.lamps_file`), but in the frame in which it
counts: the ground is y = 0. What is saved is in the world frame.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from warpir.core.arrays import Float64Array
from warpir.io.lamps_file import lamps_of, lamps_to_json, rows_of
from warpir.scene.near.lamps import Lamp, RectangleLamp


def page_lamps(lamps: tuple[Lamp, ...], ground_to_world: Float64Array) -> list[dict[str, Any]]:
    """Return lamps of the world frame as the page has them.

    Args:
        lamps: In the world frame [m].
        ground_to_world: Pose of the ground frame, shape [4, 4].
    """
    to_ground = np.asarray(np.linalg.inv(ground_to_world), np.float64)
    return rows_of(tuple(_moved(lamp, to_ground) for lamp in lamps))


def lamps_file(
    page: Path, sent: Mapping[str, Any], ground_to_world: Float64Array
) -> dict[str, Any] | None:
    """Return the list for ``--lamps`` that the page sends, None where it has no lamp.

    Args:
        page: Location in errors.
        sent: ``lamps``: rows in the ground frame; absent or null where there are none.
        ground_to_world: Pose of the ground frame, shape [4, 4].

    Raises:
        InputError: They are no such rows, or out of range.
    """
    rows = sent.get("lamps")
    if rows is None or rows == []:
        return None
    lamps = tuple(_moved(lamp, ground_to_world) for lamp in lamps_of(page, rows))
    return lamps_to_json(lamps)


def _moved(lamp: Lamp, pose: Float64Array) -> Lamp:
    """Return a lamp in another frame, by a rigid pose of shape [4, 4]."""
    turn = pose[:3, :3]
    center = turn @ lamp.center + pose[:3, 3]
    if isinstance(lamp, RectangleLamp):
        edges = turn @ lamp.edge_x, turn @ lamp.edge_y
        return replace(lamp, center=center, edge_x=edges[0], edge_y=edges[1])
    return replace(lamp, center=center)
