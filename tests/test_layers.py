"""Imports point one way: each room may import only the rooms below it, and heavy packages stay in their rooms."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent

# Rooms from the bottom up; a module may import modules of strictly lower rank, or of its own room.
RANKS = {
    "beam_warp._version": 0,
    "beam_warp.errors": 0,
    "beam_warp.kernels": 0,
    "beam_warp.checks": 1,
    "beam_warp.assets": 2,
    "beam_warp.spherical_harmonics": 2,
    "beam_warp.radiance_hdr": 2,
    "beam_warp.material_mesh": 2,
    "beam_warp.quaternions": 2,
    "beam_warp.json_fields": 2,
    "beam_warp.file_digests": 2,
    "beam_warp.time_sampling": 3,
    "beam_warp.camera_paths": 5,
    "beam_warp.stage_environments": 5,
    "beam_warp.stage_assets": 6,
    "beam_warp.stage_meshes": 6,
    "beam_warp.stage_files": 7,
    "beam_warp.stages": 8,
    "beam_warp.axes": 3,
    "beam_warp.asset_metadata": 2,
    "beam_warp.images": 3,
    "beam_warp.cameras": 3,
    "beam_warp.reference": 3,
    "beam_warp.tone_mapping": 4,
    "beam_warp.frame_times": 2,
    "beam_warp.pictures": 6,
    "beam_warp.frame_renderers": 16,
    "beam_warp.render_jobs": 7,
    "beam_warp.frame_output": 2,
    "beam_warp.shot_digests": 6,
    "beam_warp.video": 4,
    "beam_warp.environments": 4,
    "beam_warp.backdrops": 5,
    "beam_warp.lights": 2,
    "beam_warp.light_arrays": 5,
    "beam_warp.shots": 5,
    "beam_warp.lenses": 2,
    "beam_warp.undistortion": 4,
    "beam_warp.captured_views": 4,
    "beam_warp.visual_hull": 6,
    "beam_warp.initialization": 7,
    "beam_warp.sampling_limits": 6,
    "beam_warp.regularizers": 6,
    "beam_warp.camera_rigs": 4,
    "beam_warp.capture_records": 5,
    "beam_warp.nerfstudio_captures": 6,
    "beam_warp.colmap_captures": 6,
    "beam_warp.projection_captures": 6,
    "beam_warp.captures": 7,
    "beam_warp.capture_findings": 3,
    "beam_warp.camera_findings": 5,
    "beam_warp.image_findings": 6,
    "beam_warp.capture_inspection": 8,
    "beam_warp.capture_drawing": 9,
    "beam_warp.capture_page": 10,
    "beam_warp.capture_digests": 8,
    "beam_warp.schema": 4,
    "beam_warp.frame_store": 4,
    "beam_warp.converters": 5,
    "beam_warp.devices": 4,
    "beam_warp.device_arrays": 5,
    "beam_warp.depth_normals": 6,
    "beam_warp.depth_images": 6,
    "beam_warp.depth_consistency": 7,
    "beam_warp.depth_fusion": 7,
    "beam_warp.mesh_topology": 2,
    "beam_warp.mesh_files": 4,
    "beam_warp.mesh_preview": 5,
    "beam_warp.mesh_unwrapping": 3,
    "beam_warp.meshing": 9,
    "beam_warp.image_losses": 6,
    "beam_warp.joint_graph": 2,
    "beam_warp.joint_selection": 2,
    "beam_warp.motion_losses": 6,
    "beam_warp.skinning": 6,
    "beam_warp.adam": 6,
    "beam_warp.tracking": 10,
    "beam_warp.view_gains": 8,
    "beam_warp.image_motion": 4,
    "beam_warp.joint_tracking": 9,
    "beam_warp.gaussian_fitting": 9,
    "beam_warp.densification": 8,
    "beam_warp.gaussian_parameters": 7,
    "beam_warp.view_targets": 8,
    "beam_warp.step_graphs": 5,
    "beam_warp.packed_gaussians": 5,
    "beam_warp.morton_order": 5,
    "beam_warp.wide_trees": 6,
    "beam_warp.scene": 7,
    "beam_warp.tracing": 8,
    "beam_warp.surface_rays": 8,
    "beam_warp.surface_tracing": 9,
    "beam_warp.gradients": 9,
    "beam_warp.lighting": 9,
    "beam_warp.incident_light": 10,
    "beam_warp.ggx": 2,
    "beam_warp.roughness": 5,
    "beam_warp.sampling": 5,
    "beam_warp.environment_sampling": 5,
    "beam_warp.raster_layout": 5,
    "beam_warp.raster_records": 5,
    "beam_warp.rasterizer": 6,
    "beam_warp.rasterizing": 8,
    "beam_warp.view_images": 7,
    "beam_warp.interop_torch": 8,
    "beam_warp.interop": 9,
    "beam_warp.stress_cases": 9,
    "beam_warp.stress_materials": 9,
    "beam_warp.material_stability": 14,
    "beam_warp.stress_relighting": 6,
    "beam_warp.relighting_stability": 14,
    "beam_warp.stability": 10,
    "beam_warp.analytic_occlusion": 10,
    "beam_warp.stability_report": 15,
    "beam_warp.view_evidence": 9,
    "beam_warp.material_light": 10,
    "beam_warp.surfaces": 10,
    "beam_warp.traced_relighting": 12,
    "beam_warp.base_color": 12,
    "beam_warp.temporal_color": 13,
    "beam_warp.frame_inputs": 14,
    "beam_warp.roughness_estimation": 12,
    "beam_warp.deferred": 9,
    "beam_warp.environment_regions": 5,
    "beam_warp.shadow_maps": 7,
    "beam_warp.deferred_options": 6,
    "beam_warp.arriving_light": 10,
    "beam_warp.deferred_frames": 11,
    "beam_warp.deferred_rendering": 12,
    "beam_warp.materials": 11,
    "beam_warp.image_residues": 10,
    "beam_warp.denoising": 6,
    "beam_warp.baking": 7,
    "beam_warp.bake_resolution": 8,
    "beam_warp.image_path": 11,
    "beam_warp.evaluation": 9,
    "beam_warp.contact_sheet": 10,
    "beam_warp.channel_images": 11,
    "beam_warp.perceptual_scores": 2,
    "beam_warp.capture_matching": 8,
    "beam_warp.relighters": 13,
    "beam_warp.drawn_materials": 11,
    "beam_warp.temporal_scores": 12,
    "beam_warp.material_scores": 14,
    "beam_warp.evaluation_sheet": 15,
    "beam_warp.asset_evaluation": 16,
    "beam_warp.demo_shape": 3,
    "beam_warp.demo_paint": 4,
    "beam_warp.demo_figure": 5,
    "beam_warp.demo_environments": 5,
    "beam_warp.mesh_path_tracing": 6,
    "beam_warp.camera_rays": 4,
    "beam_warp.path_rendering": 9,
    "beam_warp.demo_gaussians": 7,
    "beam_warp.demo_capture": 8,
    "beam_warp.stress_captures": 9,
    "beam_warp.capture_stability": 11,
    "beam_warp.stressed_reconstruction": 17,
    "beam_warp.surface_distances": 6,
    "beam_warp.tracking_drift": 7,
    "beam_warp.reconstruction_scores": 10,
    "beam_warp.reconstruction_previews": 11,
    "beam_warp.exposure": 13,
    "beam_warp.reporting": 14,
    "beam_warp.pipeline": 15,
    "beam_warp.reconstruction": 15,
    "beam_warp.reconstruction_steps": 16,
    "beam_warp.light_check": 12,
    "beam_warp.decomposition_checks": 13,
    "beam_warp.demo_truth": 11,
    "beam_warp.demo_reconstruction": 17,
    "beam_warp.demo": 18,
    "beam_warp.tiled_shapes": 3,
    "beam_warp.surface_gaussians": 9,
    "beam_warp.materials_plan": 12,
    "beam_warp.materials_references": 11,
    "beam_warp.materials_study": 14,
    "beam_warp.charts": 6,
    "beam_warp.chart_image": 7,
    "beam_warp.chart_page": 8,
    "beam_warp.tracing_plan": 11,
    "beam_warp.tracing_references": 12,
    "beam_warp.tracing_study": 13,
    "beam_warp.view_state": 5,
    "beam_warp.view_schedule": 6,
    "beam_warp.view_frames": 7,
    "beam_warp.view_server": 2,
    "beam_warp.view_lamps": 6,
    "beam_warp.view_renderers": 15,
    "beam_warp.view_painting": 16,
    "beam_warp.viewing": 17,
    "beam_warp.cli": 19,
    "beam_warp": 20,
}

WITHOUT_WARP = (
    "errors",
    "checks",
    "assets",
    "asset_metadata",
    "axes",
    "images",
    "radiance_hdr",
    "cameras",
    "captured_views",
    "camera_rigs",
    "capture_records",
    "nerfstudio_captures",
    "colmap_captures",
    "projection_captures",
    "captures",
    "capture_findings",
    "camera_findings",
    "image_findings",
    "capture_inspection",
    "capture_drawing",
    "capture_page",
    "capture_digests",
    "lenses",
    "undistortion",
    "environments",
    "tone_mapping",
    "frame_times",
    "pictures",
    "frame_output",
    "shot_digests",
    "video",
    "backdrops",
    "lights",
    "shots",
    "quaternions",
    "json_fields",
    "file_digests",
    "time_sampling",
    "camera_paths",
    "stage_environments",
    "stage_assets",
    "stage_meshes",
    "stage_files",
    "stages",
    "view_state",
    "view_schedule",
    "view_frames",
    "view_server",
    "view_lamps",
    "material_mesh",
    "mesh_topology",
    "mesh_files",
    "mesh_unwrapping",
    "joint_graph",
    "joint_selection",
    "demo_shape",
    "demo_paint",
    "demo_figure",
    "demo_environments",
    "evaluation",
    "perceptual_scores",
    "capture_matching",
    "tiled_shapes",
    "charts",
    "chart_image",
    "chart_page",
    "schema",
    "converters",
)


def modules() -> dict[str, Path]:
    found = {}
    for folder, package in (
        ("beam_warp", "beam_warp"),
        ("kernels", "beam_warp.kernels"),
        ("schema", "beam_warp.schema"),
        ("converters", "beam_warp.converters"),
    ):
        for path in sorted((ROOT / folder).rglob("*.py")):
            parts = path.relative_to(ROOT / folder).with_suffix("").parts
            found[".".join((package, *parts)).removesuffix(".__init__")] = path
    return found


MODULES = modules()


def imports(path: Path) -> set[str]:
    """Every module that a file imports, at any depth, type-checking blocks left out."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    skipped = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        for inner in ast.walk(node)
    }
    names = set()
    for node in ast.walk(tree):
        if id(node) in skipped:
            continue
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative imports hide the room"
            names |= {node.module or ""} | {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def rank(module: str) -> tuple[str, int]:
    """The room of a module and its rank."""
    name = module
    while name not in RANKS:
        name = name.rpartition(".")[0]
        assert name, f"{module} has no room in tests/test_layers.py"
    return name, RANKS[name]


@pytest.mark.parametrize("module", MODULES)
def test_imports_point_down(module):
    room, height = rank(module)
    assert room != "beam_warp" or module == "beam_warp", f"{module} has no room in tests/test_layers.py"
    for name in imports(MODULES[module]):
        if not name.startswith("beam_warp.") or name not in MODULES:
            continue
        other_room, other_height = rank(name)
        assert other_room == room or other_height < height, f"{module} imports {name}, which lies above it"


@pytest.mark.parametrize("module", MODULES)
def test_heavy_packages_stay_in_their_rooms(module):
    room, _ = rank(module)
    names = {name.split(".")[0] for name in imports(MODULES[module])}
    assert "torch" not in names or room in ("beam_warp.interop", "beam_warp.interop_torch")
    assert "pxr" not in names or room == "beam_warp.schema"
    if room.removeprefix("beam_warp.") in WITHOUT_WARP:
        assert "warp" not in names
        assert not any(name.startswith("beam_warp.kernels") for name in imports(MODULES[module]))
    if room == "beam_warp.kernels":
        assert not {n for n in imports(MODULES[module]) if n.startswith("beam_warp.")} - {
            n for n in imports(MODULES[module]) if n.startswith("beam_warp.kernels")
        }
