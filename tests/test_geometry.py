"""Penetration depth against closed forms, Drake and sampled points; touching groups."""

# trimesh is typed in part only.
# mypy: allow-untyped-calls

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from conftest import CLASSES, TRAY, resting, rng
from numpy.typing import NDArray
from pydrake.geometry import (
    Convex,
    FramePoseVector,
    GeometryFrame,
    GeometryInstance,
    ProximityProperties,
    SceneGraph,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import DiagramBuilder
from scipy.spatial.transform import Rotation

from drake_clutter.assets import build_assets
from drake_clutter.catalog import ObjectClass, load_catalog
from drake_clutter.grammar import Orientation
from drake_clutter.scenes.geometry import (
    find_piles,
    group_touching_objects,
    max_penetration,
    penetration_depth,
    transport_pose,
)
from drake_clutter.scenes.scene import Pose, SceneObject
from drake_clutter.simulation.scene_plant import add_scene_plant

CRACKER, SUGAR = np.array([0.060, 0.160, 0.230]), np.array([0.038, 0.089, 0.175])


def turned(
    class_name: str,
    axis: str,
    degrees: float,
    translation: tuple[float, float, float],
    name: str = "b",
) -> SceneObject:
    """Return an object rotated about one axis of the tray."""
    rotation = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
    return SceneObject(name, CLASSES[class_name], Pose.from_rotation(rotation, translation))


def both_ways(first: SceneObject, second: SceneObject) -> float:
    """Return the penetration depth, which is the same in either order."""
    depth = penetration_depth(first, second)
    assert penetration_depth(second, first) == pytest.approx(depth, abs=1e-12)
    return depth


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("depth", [0.003, 0.0, -0.005])
def test_two_boxes_side_by_side(axis: int, depth: float) -> None:
    offset = np.zeros(3)
    offset[axis] = (CRACKER[axis] + SUGAR[axis]) / 2 - depth
    first, second = turned("cracker_box", "z", 0, (0, 0, 0)), turned("sugar_box", "z", 0, (0, 0, 0))
    second = SceneObject("b", second.object_class, second.X_TO.translated(offset))
    assert both_ways(first, second) == pytest.approx(depth, abs=1e-12)


def test_a_box_inside_another_is_as_deep_as_its_way_out() -> None:
    """The shortest separation is along the thin sides: half of each."""
    first, second = turned("cracker_box", "z", 0, (0, 0, 0)), turned("sugar_box", "z", 0, (0, 0, 0))
    assert both_ways(first, second) == pytest.approx((0.060 + 0.038) / 2)


@pytest.mark.parametrize("depth", [0.002, 0.0005, -0.0005])
def test_edge_on_edge(depth: float) -> None:
    """Two crossed boxes on their edges: the edges are along x and y, the centers aligned."""
    half = math.sqrt(0.5) / 2
    lower = turned(
        "cracker_box", "x", 45, (0, 0, 0)
    )  # its highest edge is where y = half * (160 - 230 mm)
    height = half * (0.160 + 0.230) + half * (0.038 + 0.175)
    upper = turned(
        "sugar_box", "y", 45, (half * (0.175 - 0.038), half * (0.160 - 0.230), height - depth)
    )
    assert both_ways(lower, upper) == pytest.approx(depth, abs=1e-9)


@pytest.mark.parametrize("gap", [0.001, -0.001])
def test_a_gap_that_the_axis_aligned_boxes_do_not_see(gap: float) -> None:
    """Two boxes rotated by 45 degrees, face to face, 1 mm apart.

    Their axis-aligned bounding boxes overlap.
    """
    away = (0.060 + gap) * math.sqrt(0.5)
    first, second = (
        turned("cracker_box", "z", 45, (0, 0, 0)),
        turned("cracker_box", "z", 45, (away, away, 0)),
    )
    assert (second.bounds_T[0] < first.bounds_T[1]).all()
    assert both_ways(first, second) == pytest.approx(-gap, abs=1e-12)


@pytest.mark.parametrize("depth", [0.003, 0.0, -0.002])
def test_a_corner_against_a_face(depth: float) -> None:
    """A box rotated by 45 degrees about z points a corner at the other's face."""
    reach = (0.038 + 0.089) / 2 * math.sqrt(0.5)
    first = turned("cracker_box", "z", 0, (0, 0, 0))
    second = turned("sugar_box", "z", 45, (0.030 + reach - depth, 0, 0))
    assert both_ways(first, second) == pytest.approx(depth, abs=1e-12)


@pytest.mark.parametrize("depth", [0.003, 0.0, -0.002])
def test_a_can_beside_a_box(depth: float) -> None:
    """The inscribed prism of 32 sides has a corner on the x axis."""
    can = resting("master_chef_can", name="can")
    box = turned("cracker_box", "z", 0, (0.051 + 0.030 - depth, 0, 0.115))
    assert both_ways(can, box) == pytest.approx(depth, abs=1e-12)


def test_a_turned_can_reads_at_most_half_a_percent_of_its_radius_too_small() -> None:
    box = turned("cracker_box", "z", 0, (0.051 + 0.030 - 0.003, 0, 0.0))
    depths = [
        both_ways(turned("master_chef_can", "z", angle, (0, 0, 0), "can"), box)
        for angle in np.linspace(0, 12, 25)
    ]
    assert max(depths) == pytest.approx(0.003)
    assert 0.003 - 0.005 * 0.051 < min(depths) < 0.003 - 0.004 * 0.051


def test_a_can_on_a_can() -> None:
    lower = resting("tomato_soup_can", name="lower")
    assert both_ways(lower, resting("tomato_soup_can", floor=0.101, name="upper")) == pytest.approx(
        0, abs=1e-12
    )
    assert both_ways(lower, resting("tomato_soup_can", floor=0.099, name="upper")) == pytest.approx(
        0.002
    )


def random_pairs(
    names: tuple[str, str], count: int, reach: float
) -> list[tuple[SceneObject, SceneObject]]:
    """Return two objects near each other, in any orientation."""
    generator = rng(1)

    def anyhow(name: str, class_name: str) -> SceneObject:
        rotation = Rotation.random(rng=generator).as_matrix()
        return SceneObject(
            name, CLASSES[class_name], Pose.from_rotation(rotation, generator.uniform(0, reach, 3))
        )

    return [(anyhow("a", names[0]), anyhow("b", names[1])) for _ in range(count)]


@pytest.mark.parametrize(
    "names",
    [("cracker_box", "sugar_box"), ("sugar_box", "pasta_box"), ("gelatin_box", "gelatin_box")],
)
def test_boxes_turned_any_way_against_drake(names: tuple[str, str]) -> None:
    builder = DiagramBuilder()
    scene_plant = add_scene_plant(
        builder, [("a", CLASSES[names[0]]), ("b", CLASSES[names[1]])], TRAY, 0.01, visuals=False
    )
    scene_plant.plant.Finalize()
    diagram = builder.Build()
    root = diagram.CreateDefaultContext()
    context = scene_plant.plant.GetMyContextFromRoot(root)
    geometries = {
        int(scene_plant.plant.GetCollisionGeometriesForBody(body)[0].get_value())
        for body in scene_plant.bodies.values()
    }
    overlapping = apart = 0
    for a, b in random_pairs(names, 200, 0.15):
        lifted = [
            SceneObject(o.name, o.object_class, o.X_TO.translated((0, 0, 1.0))) for o in (a, b)
        ]  # off the tray
        scene_plant.set_poses(context, lifted)
        query = scene_plant.scene_graph.get_query_output_port().Eval(
            scene_plant.scene_graph.GetMyContextFromRoot(root)
        )
        reported = [
            pair.depth
            for pair in query.ComputePointPairPenetration()
            if {int(pair.id_A.get_value()), int(pair.id_B.get_value())} == geometries
        ]
        depth = both_ways(a, b)
        assert bool(reported) == (depth > 0)
        if reported:
            overlapping += 1
            # Drake's box-box query prefers faces: it takes an edge-edge axis only if that is 5 %
            # better.
            assert depth - 1e-9 <= reported[0] <= 1.05 * depth + 1e-9
        else:
            apart += 1
    assert min(overlapping, apart) > 20


def many_cornered(radii: tuple[float, float, float], folder: Path) -> ObjectClass:
    """Return the class of an ellipsoid of 128 corners."""
    name = "ellipsoid"
    shape = trimesh.creation.icosphere(3)
    shape.apply_scale(radii)
    shape.export(folder / "ellipsoid.stl")
    (folder / "catalog.yaml").write_text(
        f"classes: {{{name}: {{shape: mesh, mesh: ellipsoid.stl, mass_g: 100}}}}"
    )
    build_assets(folder)
    return load_catalog(folder).classes[name]


def test_pieces_of_many_corners_against_drake(tmp_path: Path) -> None:
    """Drake's depth of convex hulls comes from GJK and EPA, which end within a tolerance."""
    ellipsoid = many_cornered((0.04, 0.03, 0.05), tmp_path)
    scene_graph = SceneGraph()
    source = scene_graph.RegisterSource("test")
    frames = [scene_graph.RegisterFrame(source, GeometryFrame(name)) for name in ("a", "b")]
    for frame in frames:
        shape = Convex(str(ellipsoid.folder / "convex_000.obj"), 1.0)
        instance = GeometryInstance(RigidTransform(), shape, "hull")
        instance.set_proximity_properties(ProximityProperties())
        scene_graph.RegisterGeometry(source, frame, instance)
    context = scene_graph.CreateDefaultContext()
    generator = rng(3)
    overlapping = 0
    for _ in range(60):
        objects = []
        poses = FramePoseVector()
        for frame in frames:
            rotation = Rotation.random(rng=generator).as_matrix()
            translation = generator.uniform(0, 0.085, 3)
            X_TO = Pose.from_rotation(rotation, translation)
            objects.append(SceneObject("a", ellipsoid, X_TO))
            poses.set_value(frame, RigidTransform(RotationMatrix(X_TO.rotation), translation))
        scene_graph.get_source_pose_port(source).FixValue(context, poses)
        query = scene_graph.get_query_output_port().Eval(context)
        (pair,) = query.ComputeSignedDistancePairwiseClosestPoints()
        depth = both_ways(*objects)
        if pair.distance < 0:
            overlapping += 1
            assert depth == pytest.approx(-pair.distance, abs=2e-6)
        else:
            assert -pair.distance - 1e-9 <= depth <= 0
    assert 20 < overlapping < 58


def test_two_balls(tmp_path: Path) -> None:
    """Hulls of 128 corners lie at most 3.5 % of the radius below the spheres."""
    radius = 0.04
    ball = many_cornered((radius, radius, radius), tmp_path)
    generator = rng(4)
    for distance in (0.05, 0.07, 0.079, 0.085):
        X_TO = Pose.from_rotation(Rotation.random(rng=generator).as_matrix(), (distance, 0, 0))
        depth = both_ways(SceneObject("a", ball, Pose((0, 0, 0))), SceneObject("b", ball, X_TO))
        assert 2 * radius - distance - 2 * 0.035 * radius <= depth <= 2 * radius - distance + 1e-9


@pytest.mark.parametrize(
    "names", [("tomato_soup_can", "cracker_box"), ("large_marker", "large_marker")]
)
def test_moving_a_cylinder_out_by_the_depth_parts_it(names: tuple[str, str]) -> None:
    """The depth separates the objects, a smaller distance in no direction does not.

    Points in both objects prove a penetration.
    """
    generator = rng(2)
    overlapping = 0
    for a, b in random_pairs(names, 40, 0.06):
        depth = both_ways(a, b)
        shared = bool(inside(b, a.X_TO.apply(points_inside(a, generator))).any())
        assert not (shared and depth < 0)
        if depth > 0.002 and overlapping < 6:
            overlapping += 1
            assert parted(a, b, 1.1 * depth)
            assert not parted(a, b, 0.9 * depth)
    assert overlapping > 3


def parted(a: SceneObject, b: SceneObject, distance: float) -> bool:
    """Return whether a translation by the distance [m] separates the objects.

    It tries 150 directions, which are at most 0.2 rad apart.
    """
    index = np.arange(150)
    height, angle = 1 - (2 * index + 1) / 150, index * math.pi * (3 - math.sqrt(5))
    ring = np.sqrt(1 - height**2)
    directions = np.column_stack([ring * np.cos(angle), ring * np.sin(angle), height])
    return any(
        penetration_depth(a, SceneObject("b", b.object_class, b.X_TO.translated(distance * d))) < 0
        for d in directions
    )


def points_inside(o: SceneObject, generator: np.random.Generator) -> NDArray[np.float64]:
    """Return points in the inscribed prism of a cylinder in O [m]. Shape (N, 3)."""
    radius, half = 0.99 * o.object_class.size[0] / 2, o.object_class.size[2] / 2
    angle, distance = (
        generator.uniform(0, 2 * math.pi, 2000),
        radius * np.sqrt(generator.uniform(size=2000)),
    )
    return np.column_stack(
        [distance * np.cos(angle), distance * np.sin(angle), generator.uniform(-half, half, 2000)]
    )


def inside(o: SceneObject, p_T: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return whether points in T are in a box, or in a cylinder of 99 % of the radius."""
    p_O = (p_T - o.X_TO.p) @ o.X_TO.rotation
    half = np.asarray(o.object_class.size) / 2
    if o.object_class.shape.value == "box":
        return np.asarray((np.abs(p_O) < half).all(axis=1))
    return np.asarray(
        (np.hypot(p_O[:, 0], p_O[:, 1]) < 0.99 * half[0]) & (np.abs(p_O[:, 2]) < half[2])
    )


def test_deepest_penetration_names_the_two() -> None:
    a, b, c = (
        resting("sugar_box", xy=(x, 0), name=name)
        for name, x in (("a", 0.0), ("b", 0.172), ("c", 0.340))
    )
    depth, *names = max_penetration([a, b, c])
    assert depth == pytest.approx(0.007)
    assert names == ["b", "c"]
    assert max_penetration([a, c])[0] == pytest.approx(-0.165)
    assert max_penetration([a]) == (-np.inf, "", "")


def names_of(groups: list[list[SceneObject]]) -> list[list[str]]:
    return [[o.name for o in group] for group in groups]


def test_touching_groups() -> None:
    """A chain of neighbors within the margin is one group, in the order of the scene."""
    chain = [
        resting("sugar_box", Orientation.FLAT_90, (x, 0.0), name=name)
        for name, x in (("a", 0.0), ("c", 0.1825), ("b", 0.091))
    ]
    high = resting("gelatin_box", xy=(0.0, 0.0), floor=0.0405, name="above a")
    far = resting("gelatin_box", xy=(0.0, 0.3), name="far")
    groups = group_touching_objects([*chain, far, high], 0.003)
    assert names_of(groups) == [["a", "c", "b", "above a"], ["far"]]
    assert names_of(group_touching_objects([*chain, far, high], 0.0005)) == [
        ["a"],
        ["c"],
        ["b"],
        ["far"],
        ["above a"],
    ]
    assert group_touching_objects([], 0.003) == []


def test_carried() -> None:
    quarter = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))
    believed, real = Pose((0.1, 0.0, 0.05)), Pose((0.11, 0.0, 0.05))
    put = transport_pose(believed, Pose((0.0, 0.2, 0.05), quarter), real)
    assert put.p == pytest.approx([0.0, 0.21, 0.05]), "the error turns with it"
    assert put.quaternion == pytest.approx(quarter)


def test_piles_are_of_objects_that_touch_not_of_bounding_boxes_that_meet() -> None:
    """A box turned by 45 deg stands 5 mm beside another one, along the diagonal."""
    box = resting("cracker_box")
    xy = (sum(box.bounds_T[1][:2]) / math.sqrt(2) + box.bounds_T[1][0] + 0.005) / math.sqrt(2)
    R = Rotation.from_euler("z", 45, degrees=True).as_matrix() @ box.X_TO.rotation
    X_TO = Pose.from_rotation(R, (xy, xy, box.X_TO.p[2]))
    turned = replace(box, name="turned", X_TO=X_TO)
    upper = resting("tomato_soup_can", xy=(xy, xy), floor=box.top_height)
    assert len(group_touching_objects([box, turned], 0.0)) == 1
    assert find_piles([box, turned, upper], 0.004) == [[box], [turned, upper]]
    assert find_piles([box, turned, upper], 0.006) == [[box, turned, upper]]
    assert find_piles([], 0.001) == []
