"""Triangles among the Gaussians: they block, they end what is seen, and nothing passes them."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from support.estimates import require_honest, require_zero_mean
from support.shapes import aligned, random_cloud, random_rays, unit
from support.shapes import along_x as rays_along_x

from beam_warp import Scene, ambient_occlusion, visibility
from beam_warp.errors import InvalidArrayError
from beam_warp.trace.first_surface import closest_surface
from beam_warp.trace.gradients import visibility_gradients
from beam_warp.trace.reference import FLOAT32_ROUNDOFF
from beam_warp.trace.transmittance import TraceOptions

RULES = (
    TraceOptions(),
    TraceOptions(acceptance="bernoulli"),
    TraceOptions(front="entry"),
    TraceOptions(cull=True),
    TraceOptions(stop=0.0),
)


def quad(half, *, x=0.0, center=(0.0, 0.0)):
    """A square of two triangles in the plane of this x."""
    corners = np.array([[-half, -half], [half, -half], [half, half], [-half, half]]) + center
    return SimpleNamespace(
        vertices=np.column_stack([np.full(4, x), corners]), faces=np.array([[0, 1, 2], [0, 2, 3]], np.int64)
    )


def on_x(positions, opacities, scale=0.05):
    places = np.outer(positions, [1.0, 0.0, 0.0]).reshape(-1, 3)
    return aligned(places, opacities, scale, normals=np.tile([-1.0, 0.0, 0.0], (len(places), 1)))


def along_x(count=1):
    return rays_along_x(0.1, count=count)


class TestVisibility:
    @pytest.mark.parametrize("options", RULES, ids=str)
    def test_a_quad_blocks_what_passes_through_it(self, device, rng, options):
        cloud = random_cloud(rng, 100, scale=(-3.0, 0.5), opacity=(0.1, 0.9))
        cloud = cloud.with_arrays(normals=unit(rng.normal(size=(100, 3))))
        origins, directions = random_rays(rng, 500)
        t = (0.25 - origins[:, 0]) / directions[:, 0]
        at = origins + t[:, None] * directions
        inside = (t > 0.0) & (np.abs(at[:, 1:]) < 0.5).all(1)
        edge = np.abs(np.abs(at[:, 1:]).max(1) - 0.5) < 1e-5
        free = visibility(Scene.from_gaussians(cloud, device), origins, directions, options=options)
        scene = Scene.from_gaussians(cloud, device, mesh=quad(0.5, x=0.25))
        result = visibility(scene, origins, directions, options=options)
        assert not edge.any()
        assert 0.02 < inside.mean() < 0.5
        assert (result[inside] == 0.0).all()
        assert np.array_equal(result[~inside], free[~inside])

    @pytest.mark.parametrize("options", RULES, ids=str)
    def test_reach_decides(self, device, options):
        scene = Scene.from_gaussians(on_x([5.0], [0.5]), device, mesh=quad(1.0))
        assert visibility(scene, *along_x(), t_max=1.999, options=options)[0] == 1.0
        assert visibility(scene, *along_x(), t_max=2.001, options=options)[0] == 0.0
        each = visibility(scene, *along_x(count=3), t_max=np.array([1.9, 2.1, np.inf], np.float32), options=options)
        assert each.tolist() == [1.0, 0.0, 0.0]

    def test_both_sides_are_opaque(self, device):
        scene = Scene.from_gaussians(on_x([], []), device, mesh=quad(1.0))
        assert visibility(scene, [[-1.0, 0.1, 0], [1.0, 0.1, 0]], [[1.0, 0, 0], [-1.0, 0, 0]]).tolist() == [0.0, 0.0]

    def test_no_ray_slips_between_triangles(self, device):
        """Along the diagonal that two triangles share, corners included."""
        scene = Scene.from_gaussians(on_x([], []), device, mesh=quad(1.0))
        y = np.linspace(-0.999, 0.999, 400)
        origins = np.column_stack([np.full(400, -1.0), y, y])
        assert not visibility(scene, origins, np.tile([1.0, 0.0, 0.0], (400, 1))).any()

    def test_triangles_stay_where_they_are_when_gaussians_move(self, device):
        cloud = on_x([-1.0], [0.5])
        scene = Scene.from_gaussians(cloud, device, mesh=quad(1.0))
        assert visibility(scene, *along_x(), t_max=1.5) == pytest.approx(1.0 - 0.5 * np.exp(-2.0), abs=1e-6)
        scene.move(cloud.positions + np.float32(9.0), cloud.orientations, cloud.scales)
        assert visibility(scene, *along_x(), t_max=1.5)[0] == 1.0
        assert visibility(scene, *along_x())[0] == 0.0

    def test_a_trimesh_is_taken(self, device):
        sphere = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
        scene = Scene.from_gaussians(on_x([], []), device, mesh=sphere)
        origins = np.array([[-2.0, y, 0.013] for y in (0.0, 0.4, 0.52, 0.9)])
        assert visibility(scene, origins, np.tile([1.0, 0, 0], (4, 1))).tolist() == [0.0, 0.0, 1.0, 1.0]


class TestClosestSurface:
    def test_gaussians_before_and_behind_a_triangle(self, device):
        cloud = on_x([1.0, -1.0, 0.5, -0.5], [0.9, 0.2, 0.8, 0.3], scale=0.1)
        scene = Scene.from_gaussians(cloud, device, mesh=quad(1.0))
        values = np.eye(4)
        hit = closest_surface(scene, *along_x(), attributes=values, options=TraceOptions(stop=0.0))
        first, second = (opacity * np.exp(-0.5) for opacity in (0.2, 0.3))
        weights = np.array([0.0, first, 0.0, (1.0 - first) * second])
        assert hit.hit_counts[0] == 2
        assert hit.transmittance == pytest.approx((1.0 - first) * (1.0 - second), abs=1e-6)
        assert hit.attributes[0] == pytest.approx(weights / weights.sum(), abs=1e-6)
        assert hit.expected_depth == pytest.approx(weights @ [3.0, 1.0, 2.5, 1.5] / weights.sum(), abs=1e-6)
        # The threshold of 0.5 is met by none before the triangle: it is the surface.
        assert (hit.gaussians[0], hit.mesh_faces[0]) == (-1, 0)
        assert hit.depth == pytest.approx(2.0, abs=1e-6)
        assert hit.mesh_depth == pytest.approx(2.0, abs=1e-6)

    def test_an_opaque_gaussian_before_the_triangle_is_the_surface(self, device):
        scene = Scene.from_gaussians(on_x([-1.0], [0.95], scale=0.3), device, mesh=quad(1.0))
        hit = closest_surface(scene, *along_x())
        assert (hit.gaussians[0], hit.hit_counts[0]) == (0, 1)
        assert hit.depth == pytest.approx(1.0, abs=1e-6)
        assert hit.mesh_depth == pytest.approx(2.0, abs=1e-6)

    def test_the_triangle_alone(self, device):
        scene = Scene.from_gaussians(on_x([3.0], [0.9]), device, mesh=quad(1.0))
        hit = closest_surface(scene, *along_x(), attributes=[[7.0]])
        assert (hit.transmittance[0], hit.hit_counts[0], hit.expected_depth[0]) == (1.0, 0, np.inf)
        assert (hit.depth[0], hit.attributes[0, 0]) == (pytest.approx(2.0, abs=1e-6), 0.0)

    def test_reach_before_the_triangle(self, device):
        scene = Scene.from_gaussians(on_x([-1.0, -0.2], [0.3, 0.3], 0.3), device, mesh=quad(1.0))
        hit = closest_surface(scene, *along_x(count=2), t_max=[1.5, 2.5])
        assert hit.hit_counts.tolist() == [1, 2]
        assert hit.mesh_faces.tolist() == [-1, 0]
        assert np.isinf(hit.mesh_depth[0])
        assert np.isinf(hit.depth[0])

    def test_the_first_of_several_triangles(self, device):
        near, far = quad(1.0, x=-0.5), quad(1.0, x=0.5)
        both = SimpleNamespace(
            vertices=np.concatenate([far.vertices, near.vertices]), faces=np.concatenate([far.faces, near.faces + 4])
        )
        scene = Scene.from_gaussians(on_x([], []), device, mesh=both)
        hit = closest_surface(scene, [[-2.0, 0.2, 0.1], [2.0, 0.2, 0.1]], [[1.0, 0, 0], [-1.0, 0, 0]])
        assert hit.mesh_depth == pytest.approx([1.5, 1.5], abs=1e-6)
        assert hit.mesh_faces.tolist() == [2, 0]


def corner_factor(a, b):
    """Form factor from a point to a rectangle of sides a and b, above it by 1, a corner straight above the point."""
    x, y = np.sqrt(1.0 + a * a), np.sqrt(1.0 + b * b)
    return (a / x * np.arctan(b / x) + b / y * np.arctan(a / y)) / (2.0 * np.pi)


class TestOcclusionBelowAPlate:
    """Source: the configuration factor of a differential element to a parallel rectangle (Howell's C-11)."""

    @pytest.mark.parametrize("half", [0.5, 1.0, 3.0])
    def test_closed_form(self, device, half):
        scene = Scene.from_gaussians(on_x([], []), device, mesh=quad(half, x=1.0))
        points = np.zeros((400, 3))
        result = ambient_occlusion(
            scene, points, np.tile([1.0, 0.0, 0.0], (400, 1)), sample_count=64, offset=0.0, sampler="iid"
        )
        errors = result.visibility - (1.0 - 4.0 * corner_factor(half, half))
        require_zero_mean(errors)
        require_honest(errors, result.standard_error, independent=True)

    def test_a_point_that_does_not_face_it_is_open(self, device):
        scene = Scene.from_gaussians(on_x([], []), device, mesh=quad(1.0, x=1.0))
        assert ambient_occlusion(scene, np.zeros((1, 3)), [[-1.0, 0, 0]], offset=0.0).visibility[0] == 1.0


def test_gradients_do_not_pass_triangles(device):
    """Gaussians behind the quad have none; those before it have none either, as V is 0 whatever they do."""
    cloud = on_x([-1.0, 1.0], [0.3, 0.4], scale=0.2)
    scene = Scene.from_gaussians(cloud, device, mesh=quad(1.0))
    options = TraceOptions(stop=0.0)
    blocked = visibility_gradients(scene, *along_x(), [1.0], options=options)
    for name in ("positions", "orientations", "scales", "opacities", "origins", "directions"):
        assert not getattr(blocked, name).any(), name
    short = visibility_gradients(scene, *along_x(), [1.0], t_max=1.9, options=options)
    free = visibility_gradients(Scene.from_gaussians(cloud, device), *along_x(), [1.0], t_max=1.9, options=options)
    assert np.array_equal(short.opacities, free.opacities)
    assert short.opacities[0] < -0.5
    assert short.opacities[1] == 0.0


def test_far_from_the_origin(device):
    """Ray origins are on float32's grid there, 1/1024 m; triangles are not, and keep their own digits."""
    shift = np.array([10_000.0, -10_000.0, 5000.0])
    plate = quad(1.0, x=0.0003)
    plate.vertices = plate.vertices + shift
    cloud = on_x([-1.0, 1.0], [0.5, 0.5], scale=0.2)
    cloud = cloud.with_arrays(positions=(cloud.positions + shift).astype(np.float32))
    scene = Scene.from_gaussians(cloud, device, mesh=plate)
    origins, directions = along_x()
    origins = (origins * [1.0, 2.5, 1.0] + shift).astype(np.float32)  # on the grid
    hit = closest_surface(scene, origins, directions)
    assert hit.mesh_depth == pytest.approx(2.0003, abs=8.0 * FLOAT32_ROUNDOFF * 2.0)
    assert hit.hit_counts[0] == 1
    assert visibility(scene, origins, directions)[0] == 0.0
    assert visibility(scene, origins, directions, t_max=1.9) == pytest.approx(hit.transmittance, abs=1e-6)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"faces": np.zeros((0, 3), int)}, "mesh.faces must hold at least one triangle, got none"),
        *(({"faces": [[0, 1, 2], [0, 2, bad]]}, r"mesh.faces must lie in \[0, 3\]") for bad in (-1, 4, 2**32)),
        *(
            (
                {"vertices": [[0, 0, 0], [0, 1, 0], [0, bad, 1]]},
                "mesh.vertices must be finite, got NaN or infinity at row 2",
            )
            for bad in (np.nan, np.inf)
        ),
        ({"faces": [[0, 1, 2, 3]]}, r"mesh.faces must have shape \(N, 3\), got \(1, 4\)"),
        ({"vertices": np.zeros((0, 3))}, r"mesh\.faces must lie in"),
        ({"faces": None}, "mesh must have vertices and faces, got SimpleNamespace without faces"),
        ({"vertices": None}, "mesh must have vertices and faces, got SimpleNamespace without vertices"),
    ],
)
def test_bad_meshes_are_refused(changes, match):
    with pytest.raises(InvalidArrayError, match=match):
        Scene.from_gaussians(on_x([0.0], [0.5]), "cpu", mesh=SimpleNamespace(**vars(quad(1.0)) | changes))
