"""Compiled distances of convex shapes against closed forms and against Drake's."""

import math
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from conftest import cell_with, resting, rng
from numpy.typing import NDArray
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    FramePoseVector,
    GeometryFrame,
    GeometryInstance,
    ProximityProperties,
    SceneGraph,
    Shape,
    Sphere,
)
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from drake_clutter.cell.fixture import Fixture
from drake_clutter.cell.pose_spec import PoseSpec
from drake_clutter.planning.collision_model import CollisionModel
from drake_clutter.planning.shape_table import ShapeTable
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.robots.serial_chain import SerialChain
from drake_clutter.simulation.scene_plant import rigid_transform

Floats = NDArray[np.float64]
STEP = 1e-5
"""Displacement for numerical derivatives [m]."""

TETRAHEDRON = np.array([[0.1, 0.0, 0.0], [-0.1, 0.1, 0.0], [-0.1, -0.1, 0.0], [0.0, 0.0, 0.2]])
SHAPES = {
    "box": Box(0.3, 0.2, 0.1),
    "cylinder": Cylinder(0.06, 0.2),
    "capsule": Capsule(0.05, 0.3),
    "sphere": Sphere(0.08),
    "convex": Convex(TETRAHEDRON.T, "tetrahedron"),
}


# The z axis of the joint is the x axis of T.
X_TJ_ALONG_X = np.array(
    [[0.0, 0.0, 1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)


class Pair:
    """A shape on a joint, by default prismatic along x, and a fixed shape, here and in Drake."""

    def __init__(
        self,
        moving: Shape,
        fixed: Shape,
        X_TJ: Floats = X_TJ_ALONG_X,
        *,
        revolute: bool = False,
    ) -> None:
        self._scene_graph = SceneGraph()
        self._source = self._scene_graph.RegisterSource("pair")
        self._frames, geometries = [], []
        for name, shape in (("moving", moving), ("fixed", fixed)):
            frame = self._scene_graph.RegisterFrame(self._source, GeometryFrame(name))
            instance = GeometryInstance(RigidTransform(), shape, name)
            instance.set_proximity_properties(ProximityProperties())
            geometries.append(self._scene_graph.RegisterGeometry(self._source, frame, instance))
            self._frames.append(frame)
        self.geometries = geometries
        self._chain = SerialChain(np.array([X_TJ, np.eye(4)]), np.array([revolute]))

    def table(self, X_moving: RigidTransform, X_fixed: RigidTransform) -> ShapeTable:
        """Return the table of both shapes at their poses; that of the moving one at q = 0."""
        return ShapeTable(
            self._scene_graph.model_inspector(),
            {self.geometries[0]: 1, self.geometries[1]: 0},
            [X_moving.GetAsMatrix4(), X_fixed.GetAsMatrix4()],
            self._chain,
            np.eye(4),
        )

    def distance(
        self,
        X_moving: RigidTransform,
        X_fixed: RigidTransform,
        threshold: float = 10.0,
        q: float = 0.0,
    ) -> tuple[float, float]:
        """Return the compiled distance and its derivative by q; NaN if cores intersect."""
        pairs, path = np.array([[0, 1]]), np.array([[q]])
        table = self.table(X_moving, X_fixed)
        found = table.find_distances(path, pairs, threshold, with_gradients=True)
        if not len(found.distances):
            return math.inf, 0.0
        return float(found.distances[0]), float(found.gradients[0, 0])

    def drake_distance(self, X_moving: RigidTransform, X_fixed: RigidTransform) -> float:
        """Return the distance according to Drake."""
        context = self._scene_graph.CreateDefaultContext()
        poses = FramePoseVector()
        poses.set_value(self._frames[0], X_moving)
        poses.set_value(self._frames[1], X_fixed)
        self._scene_graph.get_source_pose_port(self._source).FixValue(context, poses)
        query = self._scene_graph.get_query_output_port().Eval(context)
        return float(query.ComputeSignedDistancePairClosestPoints(*self.geometries).distance)


def random_pose(generator: np.random.Generator, spread: float) -> RigidTransform:
    angles = generator.uniform(-math.pi, math.pi, 3)
    return RigidTransform(RollPitchYaw(angles), generator.uniform(-spread, spread, 3))


@pytest.mark.parametrize(("first", "second"), [*product(SHAPES, SHAPES)])
def test_distances_are_those_of_drake(first: str, second: str) -> None:
    """Drake finds the nearest points of curved shapes by iteration, and stops early.

    The distance is that of two points of the shapes, so that a smaller one is the better one.
    """
    pair = Pair(SHAPES[first], SHAPES[second])
    is_curved = bool({"cylinder", "capsule"} & {first, second})
    generator = rng(5)
    num_compared = 0
    for _ in range(40):
        X_A, X_B = (random_pose(generator, 0.4) for _ in range(2))
        distance, gradient = pair.distance(X_A, X_B)
        drake = pair.drake_distance(X_A, X_B)
        if math.isnan(distance):
            assert drake < 1e-6
            continue
        num_compared += 1
        assert distance <= drake + 1e-6
        assert distance >= drake - (1e-3 if is_curved else 1e-4)
        assert pair.distance(X_A, X_B, threshold=distance - 1e-6)[0] == math.inf
        assert pair.distance(X_A, X_B, threshold=distance + 1e-6)[0] == distance
        ahead, behind = (pair.distance(X_A, X_B, q=sign * STEP)[0] for sign in (1, -1))
        shifted = pair.distance(RigidTransform([STEP, 0.0, 0.0]) @ X_A, X_B)[0]
        assert ahead == pytest.approx(shifted, abs=1e-9)
        if max(ahead, behind) - distance < 0.3 * STEP or abs(ahead + behind - 2 * distance) < 1e-8:
            assert gradient == pytest.approx((ahead - behind) / (2 * STEP), abs=0.02)
    assert num_compared > 20


@pytest.mark.parametrize(("first", "second"), [("box", "capsule"), ("convex", "sphere")])
def test_derivatives_by_the_angle_of_a_joint(first: str, second: str) -> None:
    generator = rng(8)
    for _ in range(10):
        X_TJ, X_A, X_B = (random_pose(generator, 0.4) for _ in range(3))
        pair = Pair(SHAPES[first], SHAPES[second], X_TJ.GetAsMatrix4(), revolute=True)
        distance, gradient = pair.distance(X_A, X_B)
        if math.isnan(distance):
            continue
        ahead, behind = (pair.distance(X_A, X_B, q=sign * STEP)[0] for sign in (1, -1))
        assert gradient == pytest.approx((ahead - behind) / (2 * STEP), abs=2e-3)


@pytest.mark.parametrize("name", SHAPES)
def test_the_lowest_point_of_a_moving_shape(name: str) -> None:
    """It is the distance to a wide box below, whose top is at z = -2 m."""
    generator = rng(9)
    X_TJ = random_pose(generator, 0.4)
    pair = Pair(SHAPES[name], Box(20.0, 20.0, 2.0), X_TJ.GetAsMatrix4(), revolute=True)
    below = RigidTransform([0.0, 0.0, -3.0])
    for q in (0.0, 0.7, -2.0):
        X_A = random_pose(generator, 0.4)
        (lowest,) = pair.table(X_A, below).lowest_points(np.array([[q]]), [0])
        assert lowest + 2.0 == pytest.approx(pair.distance(X_A, below, q=q)[0], abs=1e-5)


def test_distances_of_capsules_equal_those_of_their_segments() -> None:
    pair = Pair(SHAPES["capsule"], SHAPES["capsule"])
    generator = rng(6)
    t = np.linspace(-0.15, 0.15, 601)
    for _ in range(20):
        X_A, X_B = (random_pose(generator, 0.3) for _ in range(2))
        points_A, points_B = (
            X.translation() + t[:, None] * X.rotation().matrix()[:, 2] for X in (X_A, X_B)
        )
        between = np.linalg.norm(points_A[:, None] - points_B[None], axis=2).min()
        # The grid of 0.5 mm is coarser than the closest points by less than this.
        expected = between - 0.1
        assert expected - 1e-3 * 0.5 <= pair.distance(X_A, X_B)[0] <= expected + 1e-6


def test_distances_of_a_cylinder_over_a_box_equal_their_closed_form() -> None:
    pair = Pair(SHAPES["cylinder"], SHAPES["box"])
    box = RigidTransform()
    upright = RigidTransform([0.1, 0.02, 0.05 + 0.1 + 0.013])
    assert pair.distance(upright, box)[0] == pytest.approx(0.013, abs=1e-6)
    lying = RigidTransform(RollPitchYaw(math.pi / 2, 0.0, 0.3), [0.0, 0.0, 0.05 + 0.06 + 0.002])
    assert pair.distance(lying, box)[0] == pytest.approx(0.002, abs=1e-6)
    beside = RigidTransform([0.15 + 0.06 + 0.04, 0.0, 0.0])
    assert pair.distance(beside, box) == pytest.approx((0.04, 1.0), abs=1e-4)
    corner = RigidTransform([0.15 + 0.3, 0.1 + 0.4, 0.0])
    assert pair.distance(corner, box)[0] == pytest.approx(0.5 - 0.06, abs=1e-6)
    touching = RigidTransform([0.0, 0.0, 0.05 + 0.1 - 0.001])
    assert math.isnan(pair.distance(touching, box)[0])


def test_shapes_without_a_core_are_left_to_drake() -> None:
    pair = Pair(Ellipsoid(0.1, 0.2, 0.3), SHAPES["box"])
    assert math.isnan(pair.distance(RigidTransform([5.0, 0.0, 0.0]), RigidTransform())[0])


def test_only_near_shapes_without_a_core_are_reported(tmp_path: Path) -> None:
    """Distances to an ellipsoid are Drake's."""
    path = tmp_path / "egg.sdf"
    path.write_text(
        '<sdf version="1.9"><model name="egg"><link name="egg"><collision name="egg"><geometry>'
        "<ellipsoid><radii>0.1 0.1 0.2</radii></ellipsoid>"
        "</geometry></collision></link></model></sdf>"
    )
    cell = cell_with()
    fixture = Fixture(name="egg", model=str(path), pose=PoseSpec(translation=(0.3, 0.0, 0.6)))
    model = CollisionModel(cell.model_copy(update={"fixtures": (fixture,)}), [])
    q = np.array(cell.robot.home)
    distances = [d.distance for d in model.distances_below(q, 3.0) if d.pair[1] == "egg"]
    assert len(distances) >= 7, "every part of the arm"
    for threshold in (0.5 * min(distances), float(np.median(distances))):
        found = [d.distance for d in model.distances_below(q, threshold) if d.pair[1] == "egg"]
        assert sorted(found) == sorted(d for d in distances if d <= threshold)


def test_penetration_of_a_held_object_is_drakes() -> None:
    """A box that sinks 0.4 mm into the floor, and one that stands beside it."""
    cell = cell_with()
    box, beside = resting("sugar_box"), resting("tomato_soup_can", xy=(0.2, 0.2))
    model = CollisionModel(cell, [(o.name, o.object_class) for o in (box, beside)])
    model.set_object_poses([box, beside])
    tool = next(iter(cell.gripper.tools))
    q = np.array(cell.robot.home)
    robot = load_robot(cell.robot)
    X_TF = robot.X_TB @ RigidTransform(robot.forward_kinematics(q))
    X_TG = X_TF @ cell.gripper.tools[tool].X_FG
    X_TO = rigid_transform(box.X_TO.translated((0.1, 0.0, -0.0004)))
    model.attach_object(box.name, tool, X_TO.inverse() @ X_TG)
    found = {d.pair: d.distance for d in model.distances_below(q, 0.05)}
    assert found[box.name, "floor"] == pytest.approx(-0.0004, abs=1e-9)
    model.detach_object()
    everything = model.distances_along(q[None], 2.0)
    assert len(everything.distances) > 20
    assert not model.is_of_attached(everything).any()
    assert (box.name, "floor") not in {d.pair for d in model.distances_below(q, 0.05)}


def test_a_short_capsule_beside_an_edge_of_a_view() -> None:
    """Two corners of the search's triangle are one point: its area is zero.

    The closest point lies on the edge from (0, 0, 1.6) to (0.35, -0.35, 0.3), at distances a and b
    outside the planes of its two faces, whose normals have the product g.
    """
    top = [(x, y, z) for x in (-0.35, 0.35) for y in (-0.35, 0.35) for z in (0.0, 0.3)]
    pair = Pair(Capsule(0.047, 0.0022), Convex(np.array([*top, (0.0, 0.0, 1.6)]).T, "view"))
    axes = [
        [0.8664075606958632, 0.34347625397348475, 0.3624389627583978],
        [0.2273727641007468, -0.9175990531503064, 0.3260576694433786],
        [0.4445667159316204, -0.20009008124843242, -0.8731119026057137],
    ]
    X = RigidTransform(
        RotationMatrix(np.array(axes)),
        [0.16250235867494864, -0.16312998513996393, 0.9965710913590626],
    )
    end = X.multiply([0.0, 0.0, 0.0011])
    normals = np.array([[1.3, 0.0, 0.35], [0.0, -1.3, 0.35]]) / math.hypot(1.3, 0.35)
    a, b = normals @ (end - [0.0, 0.0, 1.6])
    g = normals[0] @ normals[1]
    expected = math.sqrt((a * a + b * b - 2 * a * b * g) / (1 - g * g)) - 0.047
    assert pair.distance(X, RigidTransform())[0] == pytest.approx(expected, abs=2e-7)
