"""Reads a perspective camera of a glTF 2.0 file: its node's world matrix, without its scale."""

from pathlib import Path

import numpy as np

from warpir.core.arrays import Float64Array
from warpir.core.limits import Limits
from warpir.io.cameras.source import LARGEST, PhotoCamera, choose_frame, rigid
from warpir.io.gltf.gate import Entry, GltfFile
from warpir.io.gltf.nodes import local_matrix, read_forest
from warpir.scene.camera import Camera

ASPECT_TOLERANCE = 0.01
"""How far the file's aspect ratio may be from the photo's before it is mentioned."""


def read_gltf_camera(
    path: Path, photo_size: tuple[int, int], frame: str | None, limits: Limits
) -> PhotoCamera:
    """Read a camera; its axes and the world's are ours.

    ``frame`` is the name of the camera or of its node; where neither fits, its number among the
    nodes with a camera, from 0; default: the only one. GlTF knows angles only, so the photo's width
    and height [px] are needed.

    Raises:
        InputError: Damaged, without that camera, or orthographic.
    """
    root = GltfFile(path, limits).root
    nodes, parents = read_forest(root, limits)
    placed = [node for node in nodes if "camera" in node]
    cameras = [root.item("cameras", n.integer("camera"), n, "camera") for n in placed]
    names = [
        camera.text("name", "") or node.text("name", "") or str(k)
        for k, (node, camera) in enumerate(zip(placed, cameras, strict=True))
    ]
    of_nodes = [node.text("name", "") for node in placed]
    other = "" if frame is None or frame in names else frame
    if other and of_nodes.count(other) == 1:
        k = of_nodes.index(other)
    elif other.isdecimal() and len(other) < 10 and int(other) < len(placed):
        k = int(other)  # names come first: some exporters number their cameras from 1
    else:
        k = choose_frame(path, names, frame, None, noun="camera")
    entry = cameras[k]
    if entry.text("type") != "perspective":
        raise entry.error("camera", found=entry.text("type"))
    perspective = entry.child("perspective")
    yfov = perspective.number("yfov", 0.0)
    if not 0.0 < yfov < np.pi:
        raise perspective.error("range", what="yfov", found=yfov, expected="0 to pi")
    width, height = photo_size
    notices = []
    aspect = perspective.number("aspectRatio", width / height)
    if abs(aspect * height / width - 1.0) > ASPECT_TOLERANCE:
        notices.append(
            f"the camera was made for an aspect ratio of {aspect:.4g}, the photo has "
            f"{width / height:.4g}: its vertical angle is kept"
        )
    focal = height / 2.0 / float(np.tan(yfov / 2.0))
    index = nodes.index(placed[k])
    if _is_animated(root, parents, index):
        notices.append(
            "the camera of the glTF file is animated, which is not played: its rest pose is used "
            "(give each frame of a film a file of its own, a COLMAP model or a transforms.json)"
        )
    c2w = _unscaled(placed[k], _world(nodes, parents, index))
    camera = Camera(width, height, focal, focal, width / 2.0, height / 2.0, c2w, tuple(notices))
    return PhotoCamera(camera)


def _is_animated(root: Entry, parents: dict[int, int], index: int) -> bool:
    """Return whether an animation moves a node, or one that it hangs from."""
    moved = {
        channel.child("target").integer("node", -1, low=-1)
        for animation in root.items("animations")
        for channel in animation.items("channels")
    }
    while index not in moved and index in parents:
        index = parents[index]
    return index in moved


def _world(nodes: list[Entry], parents: dict[int, int], index: int) -> Float64Array:
    """Return the matrix from a node's frame to the world's, [4, 4]."""
    world = local_matrix(nodes[index])
    while index in parents:
        index = parents[index]
        with np.errstate(over="ignore", invalid="ignore"):  # refused by `_unscaled`
            world = local_matrix(nodes[index]) @ world
    return world


def _unscaled(node: Entry, world: Float64Array) -> Float64Array:
    """Return a pose whose axes have length 1."""
    if not (np.abs(world) <= LARGEST).all():  # nor are NaN and infinity
        raise node.error("transform_too_large", what="the camera's transform", limit=LARGEST)
    lengths = np.linalg.norm(world[:3, :3], axis=0)
    if not (lengths > 0.0).all():
        raise node.error("singular", what="transform of the camera")
    pose = world.copy()
    pose[:3, :3] /= lengths
    return rigid(node.path, node.pointer.lstrip("/"), pose)
