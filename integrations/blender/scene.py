"""Between Blender's scene and warpir's files."""

import json
import runpy
import shlex
import tempfile
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from . import compositor
from .job import Failure

OWN = "warpir"
"""Custom property of objects that an estimate has added, and replaces."""
MESHES = ("MESH", "CURVE", "SURFACE", "FONT", "META")  # types that can be inserted


def photo_of(scene: Any) -> tuple[Any, Path]:
    """Return the background image of the scene's camera, and its file, which is there."""
    camera = scene.camera
    if camera is None:
        raise Failure("The scene has no camera")
    backgrounds = camera.data.background_images
    background = next((b for b in backgrounds if b.image and OWN not in b.image), None)
    if background is None:
        raise Failure("The camera has no background image: choose the photo")
    path = Path(bpy.path.abspath(background.image.filepath)).resolve()
    if not path.is_file():
        raise Failure(f"The camera's background image is not there: {path}")
    return background, path


def set_photo(scene: Any, path: str) -> None:
    """Make a file the background image of the scene's camera; add a camera where there is none."""
    if scene.camera is None:
        scene.camera = bpy.data.objects.new("photo camera", bpy.data.cameras.new("photo camera"))
        scene.collection.objects.link(scene.camera)
    try:
        image = bpy.data.images.load(path, check_existing=True)
    except RuntimeError as error:
        raise Failure(f"The photo cannot be read: {path}") from error
    view = scene.camera.data
    background = next(iter(view.background_images), None) or view.background_images.new()
    background.source, background.image, background.alpha = "IMAGE", image, 1.0
    view.show_background_images = True


def new_folder(name: str) -> Path:
    """Return a new folder beside the .blend file, or below the temporary one if it has no file."""
    home = bpy.data.filepath
    root = Path(home).parent / "warpir" if home else Path(tempfile.gettempdir(), "warpir")
    root.mkdir(parents=True, exist_ok=True)
    return Path(tempfile.mkdtemp(prefix=f"{name}-", dir=root))


def estimate_arguments(context: Any, folder: Path) -> list[str]:
    """Return what the environment's Python is asked for camera and light of the photo."""
    script, photo = Path(__file__).with_name("estimate.py"), photo_of(context.scene)[1]
    flags = shlex.split(context.scene.warpir.estimate_flags)
    return [str(script), str(photo), str(folder), *flags]


def show_estimate(scene: Any, folder: Path) -> None:
    """Set camera, light, ground and compositor; what an earlier estimate has added goes."""
    background, _ = photo_of(scene)
    for thing in [thing for thing in scene.objects if OWN in thing]:
        bpy.data.objects.remove(thing)
    before, result = set(scene.objects), folder / "result"
    script = runpy.run_path(str(result / "blender_setup.py"))
    script["set_up"](scene, scene.camera, has_object=False, has_suns=True)
    for thing in set(scene.objects) - before:
        thing[OWN] = True
    size = script["WIDTH"], script["HEIGHT"]
    if (folder / "turned").exists() or tuple(background.image.size) != size:
        # Blender does not turn pictures by their EXIF tag: this one is upright.
        background.image = bpy.data.images.load(str(result / script["PHOTO"]))
    files = result / script["PHOTO"], folder / "grain.exr", result / "response.cube"
    compositor.show_render(scene, *files)
    path = str(photo_of(scene)[1])
    scene.warpir.light, scene.warpir.light_of, scene.warpir.result = str(result), path, str(result)


def insert_arguments(context: Any, folder: Path) -> list[str]:
    """Export the selection and the camera; return what inserts them where they are."""
    scene = context.scene
    background, photo = photo_of(scene)
    things = [o for o in context.selected_objects if o.type in MESHES and OWN not in o]
    if not things:
        raise Failure("Select the object to insert")
    low, high = _bounds(context, things)
    asset, camera = folder / "selection.glb", folder / "camera.json"
    for thing in context.selected_objects:
        thing.select_set(thing in things)
    only = {"use_selection": True, "export_apply": True, "export_animations": False}
    bpy.ops.export_scene.gltf(filepath=str(asset), **only)
    camera.write_text(json.dumps(_camera_record(context, *background.image.size)), "utf-8")
    settings = scene.warpir
    # Blender's +Z up as glTF's +Y up; the ground is level and touches the selection.
    middle = 0.5 * (low + high)
    place = f"{middle[0]:.9g},{low[2]:.9g},{-middle[1]:.9g}"
    command = ["-m", "warpir.insert", "--photo", str(photo), "--asset", str(asset)]
    command += ["--camera", str(camera), f"--place={place}", f"--ground=0,1,0,{-low[2]:.9g}"]
    command += ["--out", str(folder / "result")]
    if settings.samples:  # else as many as the command line chooses
        command += ["--samples", str(settings.samples)]
    if settings.light_of == str(photo) and Path(settings.light, "run.json").is_file():
        command += ["--reuse", settings.light]
    return [*command, *shlex.split(settings.flags)]


def show_insertion(scene: Any, folder: Path) -> None:
    """Show the composite in front of the camera, and its layers in the compositor."""
    result, render = folder / "result", scene.render
    render.resolution_x, render.resolution_y = photo_of(scene)[0].image.size
    render.resolution_percentage = 100
    curves = json.loads((result / "curves.json").read_text("utf-8"))
    compositor.show_layers(scene, result / "layers.exr", not curves.get("is_clipped", True))
    planes = scene.camera.data.background_images
    plane = next((b for b in planes if b.image and OWN in b.image), None) or planes.new()
    plane.image = bpy.data.images.load(str(result / "composite.png"))
    plane.image.name, plane.image[OWN] = "warpir composite", True
    plane.alpha, plane.display_depth = 1.0, "FRONT"
    scene.warpir.result = str(result)


def _bounds(context: Any, things: list[Any]) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the objects' box as they are rendered, world frame [m]."""
    corners: list[tuple[float, ...]] = []
    for thing in things:
        evaluated = thing.evaluated_get(context.evaluated_depsgraph_get())
        mesh = evaluated.to_mesh()
        mesh.transform(evaluated.matrix_world)
        corners += [vertex.co[:] for vertex in mesh.vertices]
        evaluated.to_mesh_clear()
    if not corners:
        raise Failure("Select the object to insert: what is selected has no vertices")
    return np.min(corners, axis=0), np.max(corners, axis=0)


def _camera_record(context: Any, width: int, height: int) -> dict[str, Any]:
    """Return the scene's camera as warpir's ``camera.json``, at the photo's size [px]."""
    camera = context.scene.camera
    if camera.data.type != "PERSP":
        raise Failure("The camera is not a perspective one")
    depsgraph = context.evaluated_depsgraph_get()
    film = np.array(camera.calc_matrix_camera(depsgraph, x=width, y=height))
    y_up = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    turned = np.array(camera.evaluated_get(depsgraph).matrix_world.normalized())
    return {
        **{"w": width, "h": height, "c2w": (y_up @ turned).tolist()},
        **{"fx": film[0, 0] * width / 2.0, "fy": film[1, 1] * height / 2.0},
        **{"cx": (1.0 - film[0, 2]) * width / 2.0, "cy": (1.0 + film[1, 2]) * height / 2.0},
    }
