"""The wide tree: every Gaussian once, boxes that contain, a depth that traversal can follow, rays against nodes."""

import copy
import pickle

import numpy as np
import pytest
import warp as wp
from support.kernel_runs import run_kernel
from support.shapes import aligned, random_cloud, random_rays

from beam_warp import Scene, visibility
from beam_warp.device.arrays import resolve_device
from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.kernels.trace.wide_tree import LARGEST_DEPTH, boxes_met, first_bit, reciprocal
from beam_warp.stability.tracing import traced_cloud
from beam_warp.trace import wide_tree as wide_trees
from beam_warp.trace.packing import PackedGaussians
from beam_warp.trace.reference import FLOAT32_ROUNDOFF, visibility_enclosure
from beam_warp.trace.scene import NOTHING
from beam_warp.trace.transmittance import TraceOptions
from beam_warp.trace.wide_tree import RepeatedBuild, build_wide_tree, refit

METHODS = ("quality", "fast", "places")
WHOLE = TraceOptions(stop=0.0)


def packed_of(cloud, device):
    return PackedGaussians.from_cloud(cloud, 2, resolve_device(device))


def build(packed, method):
    return build_wide_tree(packed, int(packed.takes_part.numpy().sum()), method)


class Decoded:
    """A tree read back: who is whose child, and the boxes that rays meet, in float64."""

    def __init__(self, built):
        rows = built.tree.nodes.numpy().reshape(-1, 3, 4)[: sum(built.levels[-1])]
        words = rows[:, 0, 3].view(np.uint32)
        self.inner, self.count = (words >> 24) & 7, (words >> 28) & 7
        self.axis = ((words >> 27) & 1) | ((words >> 30) & 2)
        self.first_node, self.first_leaf = rows[:, 1, 0], rows[:, 1, 1]
        corner = np.ascontiguousarray(rows[:, 0, :3]).view(np.float32).astype(np.float64)
        exponents = (words[:, None] >> np.array([0, 8, 16])) & 255
        self.step = (exponents << 23).astype(np.uint32).view(np.float32).astype(np.float64)
        low = np.stack([rows[:, 1, 2], rows[:, 1, 3], rows[:, 2, 0]], -1).astype("<i4")
        high = np.ascontiguousarray(rows[:, 2, 1:]).astype("<i4")
        spread = [
            np.ascontiguousarray(x).view(np.uint8).reshape(-1, 3, 4).transpose(0, 2, 1).astype(float)
            for x in (low, high)
        ]
        self.lower, self.upper = (corner[:, None] + bytes_of * self.step[:, None] for bytes_of in spread)
        leaves = built.tree.leaves.numpy().reshape(-1, 3, 4)[: built.count]
        self.items = np.ascontiguousarray(leaves[:, 2, 3]).view(np.int32)
        self.whitening = np.zeros((built.count, 3, 3))
        self.whitening[:, [0, 0, 0, 1], [0, 1, 2, 1]] = leaves[:, 1]
        self.whitening[:, [1, 2], [2, 2]] = leaves[:, 2, :2]


def require_sound(built, packed):
    """Everything that traversal relies on."""
    tree = Decoded(built)
    takes_part = packed.takes_part.numpy()
    assert np.array_equal(np.sort(tree.items), np.flatnonzero(takes_part)), "a leaf for each, and only for those"
    assert len(built.levels) <= LARGEST_DEPTH
    begins, sizes = np.array(built.levels).T
    assert begins[0] == 0
    assert sizes[0] == 1
    assert np.array_equal(begins[1:], np.cumsum(sizes)[:-1])
    assert (tree.inner <= tree.count).all()
    assert (tree.count <= 4).all()
    assert built.count < 2 or (tree.count >= 2).all()
    leaf_lower, leaf_upper = packed.lowers.numpy().astype(float), packed.uppers.numpy().astype(float)
    lower, upper = np.full((len(tree.count), 3), np.inf), np.full((len(tree.count), 3), -np.inf)
    parents_of_nodes, parents_of_leaves = np.zeros(len(tree.count), int), np.zeros(built.count, int)
    for level in reversed(range(len(sizes))):
        for node in range(begins[level], begins[level] + sizes[level]):
            inner, count = int(tree.inner[node]), int(tree.count[node])
            nodes = tree.first_node[node] + np.arange(inner)
            leaves = tree.first_leaf[node] + np.arange(count - inner)
            if inner:
                assert begins[level + 1] <= nodes[0]
                assert nodes[-1] < begins[level + 1] + sizes[level + 1]
            parents_of_nodes[nodes] += 1
            parents_of_leaves[leaves] += 1
            low = np.concatenate([lower[nodes], leaf_lower[tree.items[leaves]]])
            high = np.concatenate([upper[nodes], leaf_upper[tree.items[leaves]]])
            if count:
                lower[node], upper[node] = low.min(0), high.max(0)
            assert (tree.lower[node, :count] <= low).all()
            assert (tree.upper[node, :count] >= high).all()
            # Outwards to the next step, a thousandth of a step more to be sure, and 255 steps round by 255 * 2^-24.
            loosest = (1.001 + 255.0 * 2.0**-23) * tree.step[node]
            assert (low - tree.lower[node, :count] <= loosest).all()
            assert (tree.upper[node, :count] - high <= loosest).all()
    # A step is the smallest power of two of which 254 reach across: less than twice what they need. Extent and quotient
    # are rounded; the smallest step is float32's smallest normal number.
    needed = np.where(tree.count[:, None] > 0, upper - lower, 0.0) / 254.0
    assert (tree.step <= np.maximum(2.0 * (1.0 + 4.0 * FLOAT32_ROUNDOFF) * needed, 2.0**-126)).all()
    assert parents_of_nodes[0] == 0
    assert (parents_of_nodes[1:] == 1).all()
    assert (parents_of_leaves == 1).all()


def scattered(rng, count):
    """``count`` Gaussians that take part, and as many among them that do not."""
    opacities = np.zeros(2 * count + 1)
    opacities[rng.permutation(2 * count + 1)[:count]] = rng.uniform(0.1, 1.0, count)
    return random_cloud(rng, 2 * count + 1).with_arrays(opacities=opacities)


class TestStructure:
    @pytest.mark.parametrize("method", METHODS)
    @pytest.mark.parametrize("count", [0, 1, 2, 3, 4, 5, 16, 17, 1000])
    def test_sound_as_built_and_after_a_refit(self, device, rng, method, count):
        cloud = scattered(rng, count)
        packed = packed_of(cloud, device)
        built = build(packed, method)
        assert (built.count, built.method) == (count, method)
        require_sound(built, packed)
        moved = random_cloud(rng, len(cloud))
        packed.place(
            wp.array(moved.positions, dtype=wp.vec3, device=device),
            wp.array(moved.orientations, dtype=wp.quat, device=device),
            wp.array(moved.scales, dtype=wp.vec3, device=device),
        )
        refit(built, packed)
        require_sound(built, packed)

    def test_repeated_builds_are_sound_or_none(self, device, rng):
        """None where another number takes part or the tree is much deeper; what is built after that is sound again."""
        packed = packed_of(random_cloud(rng, 300, opacity=(0.1, 1.0)), device)
        repeated = RepeatedBuild(packed, build(packed, "fast"))
        shaken, deep = rng.normal(size=(300, 3)), np.repeat(2.0 ** -np.arange(100), 3)[:, None] * [1.0, 0.0, 0.0]
        for positions, sound in ((shaken, True), (deep, False), (shaken * np.nan, False), (shaken[::-1], True)):
            packed.place(
                wp.array(positions, dtype=wp.vec3, device=device),
                wp.full(300, wp.quat(0.0, 0.0, 0.0, 1.0), dtype=wp.quat, device=device),
                wp.full(300, wp.vec3(1e-9), dtype=wp.vec3, device=device),
            )
            repeated.launch()
            built = repeated.built(int(packed.takes_part.numpy().sum()))
            assert (built is not None) == sound
            if built is not None:
                require_sound(built, packed)

    @pytest.mark.parametrize("method", METHODS)
    def test_thread_counts_make_the_same_whole_tree(self, rng, monkeypatch, method):
        """Levels of thousands of nodes: threads of the CPU, whose atomics are plain, must not count in one place."""
        packed = packed_of(random_cloud(rng, 20_000, opacity=(0.1, 1.0)), "cpu")
        trees = set()
        for threads in ("1", "2", "4", "4"):
            monkeypatch.setenv("BEAM_WARP_THREADS", threads)
            built = build(packed, method)
            assert np.array_equal(np.sort(Decoded(built).items), np.arange(20_000))
            trees.add((built.tree.nodes.numpy().tobytes(), built.tree.leaves.numpy().tobytes()))
        assert len(trees) == 1

    @pytest.mark.parametrize("method", ["quality", "fast"])
    def test_two_builds_give_the_same_bits(self, device, rng, method):
        """Numbers of nodes may differ on CUDA; what rays meet, and in which order, does not."""
        cloud, rays = random_cloud(rng, 5000), random_rays(rng, 500)
        one, other = (visibility(Scene.from_gaussians(cloud, device, build=method), *rays) for _ in range(2))
        assert np.array_equal(one, other)

    def test_the_last_corner_sorts_before_what_takes_no_part(self, device):
        """A centre at the upper corner of all axes has the largest code of all."""
        count = 5
        positions = np.concatenate([[[0.5, 0.5, 0.5]], np.repeat(np.linspace(0.0, 1.0, count)[:, None], 3, 1)])
        cloud = aligned(positions, scales=0.01).with_arrays(opacities=[0.0] + [0.5] * count)
        packed = packed_of(cloud, device)
        for method in METHODS:
            require_sound(build(packed, method), packed)

    def test_counts_of_large_clouds_do_not_depend_on_threads(self, monkeypatch):
        """300,000 rows are more than one chunk of counting threads."""
        monkeypatch.setenv("BEAM_WARP_THREADS", "4")
        count = 300_000
        packed = packed_of(aligned(np.zeros((count, 3))), "cpu")
        assert packed.fate_counts() == [count, 0, 0, 0]


ADVERSARY = np.random.default_rng(5)
POWERS = 2.0 ** -np.arange(100)[:, None]

ADVERSARIAL = {
    "coincident": np.zeros((1500, 3)),
    "100,000 duplicates": np.repeat(ADVERSARY.uniform(size=(10, 3)), 10_000, axis=0),
    "2^-k on an axis": POWERS * [1.0, 0.0, 0.0],
    "2^-k on a diagonal": POWERS * [1.0, 1.0, 1.0],
    "2^-k, each 20 times": np.repeat(POWERS * [1.0, -1.0, 0.5], 20, axis=0),
    "line": np.linspace(-1.0, 1.0, 1500)[:, None] * [0.0, 0.0, 1.0],
    "plane": ADVERSARY.uniform(size=(1500, 3)) * [1.0, 1.0, 0.0],
    "two far clusters": ADVERSARY.normal(size=(1500, 3)) * 1e-5 + (ADVERSARY.uniform(size=(1500, 1)) < 0.5),
}


class TestDepth:
    @pytest.mark.parametrize("method", METHODS)
    @pytest.mark.parametrize("name", ADVERSARIAL)
    @pytest.mark.parametrize("scale", [1e-6, 0.1])
    def test_stays_within_the_stack(self, device, method, name, scale):
        packed = packed_of(aligned(ADVERSARIAL[name], scales=scale), device)
        built = build(packed, method)
        assert len(built.levels) <= LARGEST_DEPTH
        if built.count <= 5000:
            require_sound(built, packed)

    @pytest.mark.parametrize("method", ["quality", "fast"])
    def test_too_deep_a_tree_is_built_by_places(self, device, monkeypatch, method):
        positions = np.repeat(ADVERSARIAL["2^-k on an axis"], 10, axis=0)
        packed = packed_of(aligned(positions, scales=1e-9), device)
        deep = build(packed, method)
        assert deep.method == method
        monkeypatch.setattr(wide_trees, "LARGEST_DEPTH", len(deep.levels) - 1)
        shallow = build(packed, method)
        assert shallow.method == "places"
        require_sound(shallow, packed)
        scene = Scene.from_gaussians(aligned(positions, scales=1e-3), device, build=method)
        assert scene.report.depth <= len(deep.levels) - 1

    @pytest.mark.parametrize(
        ("limit", "value", "error", "match"),
        [
            ("LARGEST_DEPTH", 2, AssertionError, "a tree over 100 boxes came out"),
            ("LARGEST_NODE_COUNT", 20, InvalidArrayError, r"cloud must make .* at most 20 nodes, got \d+ for 100 G"),
        ],
    )
    def test_a_tree_that_cannot_be_is_refused(self, device, rng, monkeypatch, limit, value, error, match):
        monkeypatch.setattr(wide_trees, limit, value)
        with pytest.raises(error, match=match):
            build(packed_of(random_cloud(rng, 100, opacity=(0.1, 1.0)), device), "quality")


class TestLeaves:
    @pytest.mark.parametrize("spread", [0.5, 2.0, 4.0])
    def test_triangular_whitening_has_the_same_gram_matrix(self, device, rng, spread):
        """Each entry of U is rounded once, so U^T U by 2 u |U|^T |U|; the rest is in double precision."""
        cloud = random_cloud(rng, 2000, scale=(-3.0, spread), opacity=(0.1, 1.0))
        packed = packed_of(cloud, device)
        tree = Decoded(build(packed, "quality"))
        rows = [getattr(packed.gaussians, f"whitening_{k}").numpy()[tree.items, :3].astype(float) for k in range(3)]
        m, u = np.stack(rows, axis=1), tree.whitening
        gram, found = m.transpose(0, 2, 1) @ m, u.transpose(0, 2, 1) @ u
        size = np.abs(u).transpose(0, 2, 1) @ np.abs(u)
        size_m = np.abs(m).transpose(0, 2, 1) @ np.abs(m)
        # Cholesky's backward error is at most (3 + 1) |U|^T |U| roundings, each product of the Gram matrix 3.
        double = 2.0**-53 * (4.0 * size + 3.0 * size_m)
        assert (np.abs(found - gram) <= (2.0 + 2.0**-20) * FLOAT32_ROUNDOFF * size + 2.0 * double).all()
        assert np.isfinite(u).all()


@wp.kernel
def meet_boxes_kernel(
    rows: wp.array2d[wp.vec4i],
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    limits: wp.array[wp.vec2],
    out_mask: wp.array[int],
):
    i = wp.tid()
    inverse = reciprocal(directions[i])
    out_mask[i] = boxes_met(rows[i, 0], rows[i, 1], rows[i, 2], origins[i], inverse, limits[i][0], limits[i][1])


@wp.kernel
def find_bits_kernel(out_lowest: wp.array[int], out_highest: wp.array[int]):
    mask = wp.tid()
    if mask > 0:
        out_lowest[mask] = first_bit(mask, False)
        out_highest[mask] = first_bit(mask, True)


def random_nodes(rng, count):
    """Nodes of four boxes about the origin, as stored, and their boxes."""
    exponents = rng.integers(110, 126, (count, 3))
    step = 2.0 ** (exponents - 127.0)
    corner = (rng.integers(-300, 100, (count, 3)) * step).astype(np.float32)
    ends = np.sort(rng.integers(0, 256, (2, count, 4, 3)), axis=0)
    large = rng.uniform(size=count) < 0.5
    ends[:, large] = ends[:, large] // 4 + np.array([0, 192])[:, None, None, None]
    flat = rng.uniform(size=(count, 4, 3)) < 0.1
    low, high = ends[0], np.where(flat, ends[0], ends[1])
    rows = np.zeros((count, 3, 4), np.int32)
    rows[:, 0, :3] = corner.view(np.int32)
    rows[:, 0, 3] = exponents @ (1, 256, 65536) + (4 << 28)
    words = [
        (x.astype(np.int64) << (8 * np.arange(4))[:, None]).sum(1).astype(np.uint32).view(np.int32) for x in (low, high)
    ]
    rows[:, 1, 2:], rows[:, 2, 0], rows[:, 2, 1:] = words[0][:, :2], words[0][:, 2], words[1]
    return rows, corner, step, low, high


class TestRaysAgainstNodes:
    def cases(self, rng, count=20_000):
        rows, corner, step, low, high = random_nodes(rng, count)
        inside = corner + step * rng.uniform(0, 255, (count, 3))
        on_plane = corner + step * np.where(rng.uniform(size=(count, 3)) < 0.5, low[:, 0], high[:, 1])
        start = np.stack([inside, on_plane, inside - 300.0 * rng.normal(size=(count, 3))])
        origins = start[rng.integers(0, 3, count), np.arange(count)].astype(np.float32)
        aim = corner + step * rng.uniform(0, 255, (count, 3)) - origins
        directions = np.where(rng.uniform(size=(count, 1)) < 0.5, aim, rng.normal(size=(count, 3)))
        odd = rng.choice(
            [0.0, -0.0, 1e-40, -1e-40, 1e-13, np.nan], p=[0.1, 0.1, 0.05, 0.05, 0.05, 0.65], size=(count, 3)
        )
        odd[np.isfinite(odd).all(axis=1), 0] = 1.0
        directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        directions = np.where(np.isnan(odd), directions, odd).astype(np.float32)
        limits = np.stack([np.zeros(count), np.full(count, 3e38)], 1)
        cut = rng.uniform(size=count) < 0.5
        limits[cut] = np.sort(np.abs(rng.normal(size=(cut.sum(), 2))) * step[cut].max(1, keepdims=True) * 200.0, axis=1)
        return (rows, corner, step, low, high), origins, directions, limits.astype(np.float32)

    def met(self, device, rows, origins, directions, limits):
        inputs = [(rows, wp.vec4i), (origins, wp.vec3), (directions, wp.vec3), (limits, wp.vec2)]
        (mask,) = run_kernel(meet_boxes_kernel, len(origins), inputs, [int], device)
        return (mask[:, None] >> np.arange(4) & 1).astype(bool)

    def test_boxes_met_agree_with_double_precision(self, device, rng):
        """No box that a ray surely meets is missed, and none is met that it misses by more than rounding explains."""
        (rows, corner, step, low, high), origins, directions, limits = self.cases(rng)
        found = self.met(device, rows, origins, directions, limits)
        floor = np.float32(1e-12)
        safe = np.where(np.abs(directions) < floor, np.where(directions < 0.0, -floor, floor), directions)
        inverse = 1.0 / safe.astype(float)
        offset = corner.astype(float) - origins
        t = [(offset[:, None] + x * step[:, None]) * inverse[:, None] for x in (low, high)]
        near, far = np.minimum(*t), np.maximum(*t)
        # Difference, its product, the byte's product, the sum, and the reciprocal in both products: 5 roundings.
        error = 5.0 * FLOAT32_ROUNDOFF * ((np.abs(offset) + 255.0 * step) * np.abs(inverse))[:, None]
        t_min, t_max = limits.astype(float).T[:, :, None]
        surely = np.maximum((near + error).max(2), t_min) <= np.minimum((far - error).min(2), t_max)
        widened = (far + error).min(2)
        possibly = np.maximum((near - error).max(2), t_min) <= np.minimum(
            np.maximum(widened, widened * 1.000003), t_max
        )
        assert not (surely & ~found).any()
        assert not (found & ~possibly).any()
        assert 0.05 < surely.mean() < 0.95
        assert (surely == possibly).mean() > 0.9

    def test_first_and_last_bit(self, device):
        lowest, highest = run_kernel(find_bits_kernel, 16, [], (int, int), device)
        for mask in range(1, 16):
            bits = [k for k in range(4) if mask >> k & 1]
            assert (lowest[mask], highest[mask]) == (bits[0], bits[-1])


def require_enclosed(scene, cloud, rays):
    truth = visibility_enclosure(traced_cloud(cloud, scene), *rays, middle=scene.origin)
    result = visibility(scene, *rays, options=WHOLE)
    assert ((result >= truth.low) & (result <= truth.high)).all()
    assert truth.exact.min() < 0.5


class TestMove:
    @pytest.mark.parametrize("tree", ["refit", "fast", "quality"])
    @pytest.mark.parametrize("as_warp", [False, True])
    def test_moved_scene_equals_a_fresh_one(self, device, rng, tree, as_warp):
        cloud, moved = (random_cloud(rng, 400, scale=(-2.5, 0.5), opacity=(0.1, 0.9)) for _ in range(2))
        moved = moved.with_arrays(opacities=cloud.opacities)
        rays = random_rays(rng, 400)
        scene = Scene.from_gaussians(cloud, device)
        before = visibility(scene, *rays)
        arrays = (moved.positions, moved.orientations, moved.scales)
        if as_warp:
            types = (wp.vec3, wp.quat, wp.vec3)
            arrays = [wp.array(x, dtype=t, device=device) for x, t in zip(arrays, types, strict=True)]
        scene.move(*arrays, tree=tree)
        require_enclosed(scene, moved, rays)
        require_enclosed(Scene.from_gaussians(moved, device), moved, rays)
        assert np.abs(visibility(scene, *rays) - before).max() > 0.5
        assert scene.report.traced == 400

    @pytest.mark.parametrize("tree", ["refit", "fast", "quality"])
    def test_an_empty_scene_moves_too(self, device, tree):
        scene = Scene.from_gaussians(aligned(np.zeros((0, 3))), device)
        scene.move(np.zeros((0, 3)), np.zeros((0, 4)), np.zeros((0, 3)), tree=tree)
        assert scene.report.traced == 0
        assert visibility(scene, np.zeros((1, 3)), [[1.0, 0.0, 0.0]]) == 1.0

    def test_the_report_follows_refits(self, device, rng):
        """A row may break and come back; one that was broken when the tree was built stays out, and is counted."""
        cloud = random_cloud(rng, 20, scale=(-2.0, 0.3), opacity=(0.1, 0.9))
        cloud = cloud.with_arrays(opacities=np.r_[0.0, cloud.opacities[1:]])
        broken = cloud.positions.copy()
        broken[7] = np.nan
        scene = Scene.from_gaussians(cloud, device)

        def counts(positions, scales=cloud.scales, tree="refit"):
            scene.move(positions, cloud.orientations, scales, tree=tree)
            report = scene.report
            return report.traced, report.dropped, report.raised_scales, report.not_finite

        assert counts(broken) == (18, 1, 0, 1)
        assert counts(cloud.positions) == (19, 1, 0, 0)
        assert counts(cloud.positions, cloud.scales * [1.0, 1.0, 0.0]) == (19, 1, 19, 0)
        assert counts(broken, tree="fast") == (18, 1, 0, 1)
        assert counts(cloud.positions) == (18, 1, 0, 1)
        assert scene.report.build == "fast"

    def test_bad_shapes_and_types_are_refused(self, device, rng):
        cloud = random_cloud(rng, 10)
        scene = Scene.from_gaussians(cloud, device)
        good = (cloud.positions, cloud.orientations, cloud.scales)
        for place, name in enumerate(("positions", "orientations", "scales")):
            for bad, match in (
                (good[place][:9], r"have as many rows as the scene \(10\), got 9"),
                (good[place][:, :2], "have shape"),
                (wp.zeros(10, dtype=float, device=device), "be a one-dimensional warp array of"),
            ):
                with pytest.raises(InvalidArrayError, match=f"{name} must {match}"):
                    scene.move(*good[:place], bad, *good[place + 1 :])


def test_a_scene_is_not_copied():
    scene = Scene.from_gaussians(NOTHING, "cpu")
    for copied in (copy.copy, copy.deepcopy, pickle.dumps):
        with pytest.raises(InvalidOptionError, match="scene must stay in the process that made it"):
            copied(scene)
