"""The scene's compositor: Cycles' render over the photo as its camera saw it, or warpir's layers.

warpir's linear light is that of gamma 2.2; the last node hands the codes to the view transform
Standard, which would encode them by the sRGB curve, as it does the light of a scene-linear plate.
"""

from pathlib import Path
from typing import Any

import bpy

GAMMA = 2.2
OWN = "warpir "
"""First letters of the names of nodes that are ours to replace."""
CURVE_POINTS = 33


class Graph:
    """A scene's node tree; in Blender 5 it is a group, and shares some nodes with materials."""

    def __init__(self, scene: Any) -> None:
        self.is_group = hasattr(scene, "compositing_node_group")
        if self.is_group:
            if scene.compositing_node_group is None:
                tree = bpy.data.node_groups.new("Compositor", "CompositorNodeTree")
                tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
                scene.compositing_node_group = tree
            self.tree = scene.compositing_node_group
        else:
            scene.use_nodes = True
            self.tree = scene.node_tree
        for node in [node for node in self.tree.nodes if node.name.startswith(OWN)]:
            self.tree.nodes.remove(node)
        view, render = scene.view_settings, scene.render
        view.view_transform, view.look, view.exposure, view.gamma = "Standard", "None", 0.0, 1.0
        render.image_settings.color_management, render.dither_intensity = "FOLLOW_SCENE", 0.0

    def node(self, kind: str, name: str, *inputs: Any, **values: Any) -> Any:
        """Return a new node; its inputs are linked or set in their order."""
        is_shared = self.is_group and kind in ("Gamma", "Math", "MixRGB")
        node = self.tree.nodes.new(("ShaderNode" if is_shared else "CompositorNode") + kind)
        node.name = node.label = OWN + name
        node.location = (220.0 * len(self.tree.nodes), 0.0)
        for key, value in values.items():
            setattr(node, key, value)
        for socket, value in zip(node.inputs, inputs, strict=False):
            if isinstance(value, bpy.types.NodeSocket):
                self.tree.links.new(value, socket)
            else:
                socket.default_value = value
        return node

    def value(self, kind: str, name: str, *inputs: Any, **values: Any) -> Any:
        """Return the first output of a new node."""
        return self.node(kind, name, *inputs, **values).outputs[0]

    def mix(self, how: str, factor: Any, first: Any, second: Any) -> Any:
        """Return the colour of a mix."""
        return self.value("MixRGB", how, factor, first, second, blend_type=how)

    def image(self, name: str, path: Path) -> Any:
        """Return a file's values, not interpreted."""
        image = bpy.data.images.load(str(path))
        image.colorspace_settings.name = "Non-Color"
        return self.value("Image", name, image=image)

    def over(self, behind: Any, front: Any, alpha: Any) -> Any:
        """Return a premultiplied colour over another."""
        return self.mix("ADD", 1.0, self.mix("MIX", alpha, behind, (0.0, 0.0, 0.0, 1.0)), front)

    def curve(self, name: str, color: Any, points: list[tuple[float, float]]) -> Any:
        """Return a colour behind a curve on all channels, from (0, 0) to (1, 1)."""
        node = self.node("CurveRGB", name)
        curve = node.mapping.curves[3]
        for x, y in points[1:-1]:
            curve.points.new(x, y)
        for point in curve.points:
            point.handle_type = "VECTOR"
        node.mapping.update()
        self.tree.links.new(color, node.inputs["Image"])
        return node.outputs[0]

    def show(self, picture: Any, is_display: bool = True) -> None:
        """Make display values, or else linear ones, the scene's picture."""
        if is_display:
            spaces = {"from_color_space": "sRGB", "to_color_space": "Linear Rec.709"}
            picture = self.value("ConvertColorSpace", "codes", picture, **spaces)
        kind = "NodeGroupOutput" if self.is_group else "CompositorNodeComposite"
        ends = [node for node in self.tree.nodes if node.bl_idname == kind]
        self.tree.links.new(picture, (ends or [self.tree.nodes.new(kind)])[0].inputs[0])


def show_layers(scene: Any, layers: Path, is_plate: bool) -> None:
    """Compose ``layers.exr`` by the formula of docs/handoff.md; a scene-linear plate stays so."""
    graph = Graph(scene)
    planes = graph.node("Image", "layers", image=bpy.data.images.load(str(layers))).outputs
    behind = graph.mix("MULTIPLY", 1.0, planes["plate"], planes["shadow"])
    alpha = graph.node("SeparateColor", "coverage", planes["fg"]).outputs["Alpha"]
    picture = graph.over(behind, planes["fg"], alpha)
    if "mirror" in planes:
        picture = graph.mix("ADD", 1.0, picture, planes["mirror"])
    if "grain" in planes:
        picture = graph.mix("ADD", 1.0, picture, planes["grain"])
    if not is_plate:
        picture = graph.value("Gamma", "display", picture, 1.0 / GAMMA)
    graph.show(picture, is_display=not is_plate)


def show_render(scene: Any, photo: Path, grain: Path, response: Path) -> None:
    """Put Cycles' render over the photo, through the camera's response and with its grain.

    Args:
        scene: With film transparent and a shadow catcher.
        photo: The upright photo.
        grain: Noise in display values; left out where there is no such file.
        response: ``response.cube``, likewise.
    """
    graph = Graph(scene)
    render = graph.node("RLayers", "render", scene=scene).outputs
    plate = shown = graph.image("photo", photo)
    points = _display_curve(response) if response.is_file() else []
    if points:
        shown = graph.curve("response undone", shown, [(y, x) for x, y in points])
    light = graph.value("Gamma", "light", shown, GAMMA)
    shown = graph.over(light, render[0], render["Alpha"])
    shown = graph.value("Gamma", "display", shown, 1.0 / GAMMA)
    if points:
        shown = graph.curve("response", shown, points)
    if grain.is_file():
        # What is left of the photo's own grain and what is added keep its variance.
        rest = graph.value("Math", "rest", 1.0, render["Alpha"], operation="SUBTRACT")
        kept = graph.value("Math", "kept", rest, rest, operation="MULTIPLY")
        lost = graph.value("Math", "lost", 1.0, kept, operation="SUBTRACT")
        share = graph.value("Math", "share", lost, operation="SQRT")
        shown = graph.mix("ADD", share, shown, graph.image("noise", grain))
    touched = graph.value("Math", "touched", render["Alpha"], 1e-4, operation="GREATER_THAN")
    graph.show(graph.mix("MIX", touched, plate, shown))


def _display_curve(path: Path) -> list[tuple[float, float]]:
    """Return points of a 1-D ``.cube`` between display values, first and last at 0 and 1."""
    rows = path.read_text("utf-8").splitlines()
    table = [float(row.split()[0]) for row in rows if row[:1].isdigit()]
    displays = [k / (CURVE_POINTS - 1) for k in range(CURVE_POINTS)]
    values = [table[round(display**GAMMA * (len(table) - 1))] for display in displays]
    return [(x, y ** (1.0 / GAMMA)) for x, y in zip(displays, values, strict=True)]
