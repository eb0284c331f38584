"""The import table of the project: who may import whom, lazy imports included."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent

MITSUBA_PARTS = {"mitsuba_light", "mitsuba_material", "mitsuba_path"}

# Each module of warpir/ imports modules of lower levels only; a module that is on no level fails.
LEVELS = (
    {
        "errors", "signals", "color", "acceptance",
        "contact_sheet", "evaluation_report", "photo_look", "training_batches", "study_plan",
        "page_policy",
    },
    {"limits", "atomic", "caches", "study_report"},
    {
        "optimize_settings", "asset", "strict_json", "image_errors", "lpips", "image_decoder",
        "lens", "colmap_model", "memory", "bad_pixels", "determinism",
    },
    {"config", "color_profile"},
    {
        "camera", "asset_files", "record", "progress", "light", "tone", "curves", "materials_file",
        "ply", "stl", "model_files", "study_pairs",
    },
    {"envmap_conventions", "proxy_mesh", "lamps", "study_key", "study_pages"},
    {
        "gltf_file", "gltf_writer", "mtl", "files", "photo_files", "command", "placement",
        "lobes_file", "lobe_fit", "regressor", "light_errors", "camera_source", "point_cloud",
        "ground", "sheen", "light_words", "report_plots", "study_answers", "preview_asset",
        "place_server",
    },
    {
        "gltf_material", "obj", "reuse", "program", "regressor_training", "training_lights",
        "training_meshes", "panorama_crop", "three_spheres", "undistort", "free_space", "colmap",
        "fspy", "nerfstudio", "waymo", "exr_camera", "shadow_mask", "report_facts",
        "report_pictures", "study_images", "study_score", "study_server", "stance", "video",
    },
    {"finished"},
    {"gltf", "evaluation_scenes", "predictions", "photo_world", "report"},
    {"gltf_camera"},
    {"camera_files"},
    {"inputs", "scene"},
    {"render", "lighting", "disk_space"},
    {"picture", "samples", "sequence", "estimate", "handoff", "placing"},
    {"detail", "report_sequence"},
    {"integrator", "fusion", "sg_light", "mitsuba_scene", *MITSUBA_PARTS},
    {"mitsuba_render"},
    {"bridge", "trust"},
    {"mis", "transport_rows", "transport_matrix", "regularizers", "evaluation_stage"},
    {"transport_cache"},
    {"transport"},
    {"transport_choice", "view"},
    {"checkpoint", "lit_frame"},
    {"optimize"},
    {"light_optimization"},
    {"recover"},
    {"refine", "evaluation_rows"},
    {"demo"},
    {"insert", "prior_images", "model_check"},
    {"check_model", "train", "evaluate", "study", "place", "manifest", "batch_task"},
    {"batch_worker", "batch_local"},
    {"batch_ray"},
    {"batch"},
)  # fmt: skip
# A dispatcher by file extension: it calls the readers, and they fill its records.
UPWARD = {("asset", "gltf"), ("asset", "obj")}

# Where a package may be imported at all. A folder stands for all modules in it.
ONLY_IN = {
    "warp": {
        "kernels", "scene", "render", "samples", "bridge", "transport", "transport_rows",
        "prior_images", "determinism",
    },
    "torch": {
        "diffusion", "tone", "bridge", "integrator", "fusion", "sg_light", "regularizers", "view",
        "mis", "transport", "transport_cache", "transport_choice", "transport_matrix", "checkpoint",
        "optimize", "light_optimization", "recover", "refine", "insert", "prior_images",
        "model_check", "acceptance", "lit_frame", "trust", "regressor", "regressor_training",
        "training_batches", "training_lights", "photo_look", "lpips", "evaluation_rows",
        "evaluation_stage", "train", "evaluate", "determinism",
    },
    "trimesh": {"training_meshes"},
    "OpenImageIO": {"files", "image_decoder", "color_profile"},
    "OpenEXR": {"files"},
    "PIL": {
        "color_profile", "asset_files", "gltf_writer", "demo", "diffusion", "contact_sheet",
        "report_pictures", "placing", "preview_asset",
    },
    "diffusers": {"diffusion"},
    "transformers": {"diffusion"},
    "peft": {"diffusion"},
    "safetensors": {
        "diffusion", "checkpoint", "transport_cache", "regressor", "regressor_training", "lpips",
    },
    "colour": {"color"},
    "yaml": {"command"},
    "rich": {"progress", "study_report"},
    "ray": {"batch_ray"},
    "mitsuba": {*MITSUBA_PARTS, "mitsuba_render"},
    "drjit": {*MITSUBA_PARTS, "mitsuba_render"},
}  # fmt: skip
DIFFUSION_IN = {"recover", "refine", "prior_images", "model_check", "train", "evaluation_rows"}
"""Who drives the diffusion model; everyone else sees its settings and wording, which are plain."""
DIFFUSION_SEES = {"atomic", "caches"}
"""What diffusion shares with its host: the one way in which files are written."""
SETTINGS = ("warpir.diffusion.settings", "warpir.diffusion.prompts")
SETTINGS_IN = {"config", "command", *DIFFUSION_IN}
FILES = ("model_error", "model_folder", "weight_files")
"""What checks the models' files, without torch."""
FILES_IN = {"model_files", "program", "record", "regressor", *DIFFUSION_IN}
NOT_IN_KERNELS = {"numpy", "warpir"}
"""``warpir.kernels`` sees Warp and itself."""


def sources() -> list[Path]:
    folders = ("warpir", "kernels", "diffusion", "notebooks", "benchmarks", "tests")
    return sorted(path for folder in folders for path in (ROOT / folder).rglob("*.py"))


def imports(path: Path) -> list[tuple[int, str]]:
    """Return (line, absolute dotted name) of every import that can run, wherever it stands."""
    found: list[tuple[int, str]] = []
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for block in ast.walk(tree):
        if isinstance(block, ast.If) and ast.unparse(block.test) == "TYPE_CHECKING":
            block.body = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            dots = "." * node.level
            found += [(node.lineno, f"{dots}{node.module or ''}.{a.name}") for a in node.names]
    return found


def module_of(name: str) -> str:
    """Return the part of a dotted name that the table knows: ``warpir.gltf.read`` is ``gltf``."""
    parts = name.split(".")
    return parts[1] if parts[0] == "warpir" and len(parts) > 1 else ""


def level(module: str) -> int:
    return next((i for i, names in enumerate(LEVELS) if module in names), -1)


def place_of(path: Path) -> str:
    """Return the folder for kernels/ and diffusion/, the module's name within warpir/."""
    parts = path.relative_to(ROOT).parts
    return parts[0] if parts[0] != "warpir" else Path(parts[1]).stem


@pytest.mark.parametrize("path", sources(), ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_follow_the_table(path: Path) -> None:
    """Every import is absolute, never of top-level kernels or diffusion, and only downward."""
    folder, place = path.relative_to(ROOT).parts[0], place_of(path)
    for line, name in imports(path):
        where, top, target = f"{path.relative_to(ROOT)}:{line}: {name}", "", module_of(name)
        assert not name.startswith("."), f"{where}: relative import"
        top = name.split(".")[0]
        assert top not in ("kernels", "diffusion"), f"{where}: import it as warpir.{top}"
        if folder == "notebooks":
            assert target != "kernels", f"{where}: notebooks use warpir alone"
        if folder not in ("warpir", "kernels", "diffusion"):
            continue
        if top in ONLY_IN:
            assert place in ONLY_IN[top], f"{where}: {top} is imported in {sorted(ONLY_IN[top])}"
        if folder == "kernels":
            assert top not in NOT_IN_KERNELS or target == "kernels", f"{where}: kernels see Warp"
        elif folder == "diffusion":
            allowed = {"diffusion", *DIFFUSION_SEES}
            assert top != "warpir" or target in allowed, f"{where}: diffusion stands alone"
        elif top == "warpir" and target and target != place and place != "__init__":
            if target == "kernels":
                assert place in ONLY_IN["warp"], f"{where}: only Warp's callers see the kernels"
            elif target == "diffusion":
                is_settings = name.startswith(SETTINGS)
                is_files = name.split(".")[2] in FILES
                allowed = SETTINGS_IN if is_settings else FILES_IN if is_files else DIFFUSION_IN
                assert place in allowed, f"{where}: imported in {sorted(allowed)}"
            elif (place, target) not in UPWARD and level(target) >= 0:
                assert level(target) < level(place), f"{where}: imports its own level or higher"


def test_layers_name_every_module() -> None:
    """A new module must be put on a level before it is used."""
    modules = {place_of(p) for p in (ROOT / "warpir").rglob("*.py")} - {"__init__"}
    assert {m for m in modules if level(m) < 0} == set()


def test_layers_settings_are_plain() -> None:
    """What the command line reads of the diffusion model and the loop costs nothing to import."""
    for path in (ROOT / "diffusion" / "settings.py", ROOT / "warpir" / "optimize_settings.py"):
        assert {name for _, name in imports(path)} == {"dataclasses.dataclass"}


def test_layers_models_are_checked_without_torch() -> None:
    """Neither at the top of these modules nor in their functions."""
    for name in FILES:
        tops = {found.split(".")[0] for _, found in imports(ROOT / "diffusion" / f"{name}.py")}
        assert not tops & {"torch", "diffusers", "transformers", "peft"}


def test_layers_package_imports_nothing() -> None:
    """``import warpir`` costs nothing."""
    assert imports(ROOT / "warpir" / "__init__.py") == []
