"""Robot in a MultibodyPlant: model, actuators and collision filters.

Frames: T is the support and the world, B is the robot's base.
"""

from collections import defaultdict
from functools import lru_cache
from itertools import combinations, product

import numpy as np
from pydrake.geometry import CollisionFilterDeclaration, GeometrySet, SceneGraph
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex, RigidBody
from pydrake.systems.framework import Diagram, DiagramBuilder

from drake_clutter.robots.model_parsing import parse_model
from drake_clutter.robots.robot_model import RobotModel

_NUM_SAMPLES = 200
"""Random configurations at which distances between links are sampled."""
_ADJACENT_DISTANCE = 0.01
"""Distance below which two links are adjacent in a sample [m]."""
_MAX_STATIONARY_RADIUS = 0.25
"""Radius about the first joint's axis within which a link counts as stationary [m]: the shoulder
of an articulated arm."""
PEDESTAL_NAME = "pedestal"
"""Name of the geometry of the box under the base."""


def add_robot(plant: MultibodyPlant, robot: RobotModel, *, visuals: bool) -> ModelInstanceIndex:
    """Add a robot to a plant before it is finalized.

    Every joint has an actuator and the limits of the work cell afterwards.

    Args:
        plant: Plant to which the robot is added.
        robot: Robot with the pose of its base.
        visuals: Whether to add visual geometry.
    """
    spec = robot.spec
    instance = parse_model(plant, spec.model, visuals=visuals)
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName(spec.base_link, instance), spec.X_TB)
    _add_actuators(plant, robot, instance)
    for k, name in enumerate(robot.joint_names):
        joint = plant.GetJointByName(name, instance)
        if spec.limits.position is not None:
            lower, upper = robot.position_limits[k]
            joint.set_position_limits([lower], [upper])
    return instance


def _add_actuators(plant: MultibodyPlant, robot: RobotModel, instance: ModelInstanceIndex) -> None:
    """Give each joint an actuator, in the order of `RobotModel.joint_names`.

    Commands to the plant have the order of the actuators. If that of the model differs, or a joint
    has none, all actuators are replaced.
    """
    actuators = [plant.get_joint_actuator(index) for index in plant.GetJointActuatorIndices()]
    actuators = [actuator for actuator in actuators if actuator.model_instance() == instance]
    properties = {
        actuator.joint().name(): (actuator.default_rotor_inertia(), actuator.default_gear_ratio())
        for actuator in actuators
    }
    if tuple(properties) == robot.joint_names:
        if robot.spec.limits.torque is not None:
            for actuator, torque in zip(actuators, robot.torque_limits.tolist(), strict=True):
                actuator.set_effort_limit(torque)
        return
    for actuator in actuators:
        plant.RemoveJointActuator(actuator)
    for name, torque in zip(robot.joint_names, robot.torque_limits.tolist(), strict=True):
        actuator = plant.AddJointActuator(name, plant.GetJointByName(name, instance), torque)
        inertia, ratio = properties.get(name, (0.0, 1.0))
        actuator.set_default_rotor_inertia(inertia)
        actuator.set_default_gear_ratio(ratio)


def filter_collisions(
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    robot: RobotModel,
    instance: ModelInstanceIndex,
) -> None:
    """Filter out collisions that cannot occur, after all geometry is registered.

    These are collisions between `allowed_collision_pairs`, between `stationary_links` and the
    world, and between the other links of the first joint and the pedestal.

    Args:
        plant: Plant with the robot.
        scene_graph: Scene graph of the plant.
        robot: Robot.
        instance: Model instance of the robot.
    """

    def geometries(body: RigidBody) -> GeometrySet:
        return GeometrySet(plant.GetCollisionGeometriesForBody(body))

    bodies = {name: plant.GetBodyByName(name, instance) for name in robot.link_depths}
    stationary = stationary_links(robot)
    world = geometries(plant.world_body())
    inspector = scene_graph.model_inspector()
    world_geometries = plant.GetCollisionGeometriesForBody(plant.world_body())
    pedestal = GeometrySet(
        [g for g in world_geometries if inspector.GetName(g).split("::")[-1] == PEDESTAL_NAME]
    )
    excluded = [(world, bodies[name]) for name in stationary]
    excluded += [
        (pedestal, bodies[name])
        for name, depth in robot.link_depths.items()
        if depth == 1 and name not in stationary
    ]
    excluded += [
        (geometries(bodies[first]), bodies[second])
        for first, second in allowed_collision_pairs(robot)
    ]
    filters = scene_graph.collision_filter_manager()
    for first, second in excluded:
        filters.Apply(CollisionFilterDeclaration().ExcludeBetween(first, geometries(second)))


@lru_cache(maxsize=32)
def stationary_links(robot: RobotModel) -> tuple[str, ...]:
    """Return the links that occupy the same space in all configurations.

    No joint moves them, or only a revolute first joint, within `_MAX_STATIONARY_RADIUS`.
    """
    plant, scene_graph, diagram = _build_robot_diagram(robot)
    root = diagram.CreateDefaultContext()
    query = scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(root))
    X_TJ = robot.X_TB.GetAsMatrix4() @ robot.chain.joint_frames(np.zeros(robot.num_joints))[0]
    p_TJ = X_TJ[:3, 3]
    axis_T = X_TJ[:3, 2]

    def radius(name: str) -> float:
        """Return the largest distance of a link from the axis of the first joint [m]."""
        largest = 0.0
        for geometry in plant.GetCollisionGeometriesForBody(plant.GetBodyByName(name)):
            box = query.inspector().GetObbInGeometryFrame(geometry)
            if box is None:
                return np.inf
            X_TG = query.GetPoseInWorld(geometry) @ box.pose()
            corners = [X_TG @ (box.half_width() * signs) for signs in product((-1, 1), repeat=3)]
            offsets = np.cross(np.array(corners) - p_TJ, axis_T)
            largest = max(largest, float(np.linalg.norm(offsets, axis=1).max()))
        return largest

    is_revolute = bool(robot.chain.revolute[0])
    return tuple(
        name
        for name, depth in robot.link_depths.items()
        if depth == 0 or (depth == 1 and is_revolute and radius(name) < _MAX_STATIONARY_RADIUS)
    )


@lru_cache(maxsize=32)
def allowed_collision_pairs(robot: RobotModel) -> tuple[tuple[str, str], ...]:
    """Return the pairs of links that are not checked for collision with each other.

    These are neighbors, and links two joints apart whose collision geometries either never collide
    in random configurations, or are adjacent in most of them: their geometries overlap at the
    joints, while the real links do not (reasons "Never" and "Default" of MoveIt's allowed collision
    matrix).
    """
    pairs = list(combinations(robot.link_depths, 2))
    joints_between = {
        pair: abs(robot.link_depths[pair[0]] - robot.link_depths[pair[1]]) for pair in pairs
    }
    distances = _sample_link_distances(robot)
    allowed = [pair for pair in pairs if joints_between[pair] <= 1]
    for pair in pairs:
        sampled = np.array(distances[frozenset(pair)])
        never_collides = not (sampled < 0).any()
        is_mostly_adjacent = len(sampled) > _NUM_SAMPLES / 2
        if joints_between[pair] == 2 and (never_collides or is_mostly_adjacent):
            allowed.append(pair)
    return tuple(allowed)


def _build_robot_diagram(robot: RobotModel) -> tuple[MultibodyPlant, SceneGraph, Diagram]:
    """Return plant, scene graph and diagram of the robot alone."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0)
    add_robot(plant, robot, visuals=False)
    plant.Finalize()
    return plant, scene_graph, builder.Build()


def _sample_link_distances(robot: RobotModel) -> dict[frozenset[str], list[float]]:
    """Return the distances between links in random configurations [m].

    Returns:
        Distances below `_ADJACENT_DISTANCE`, one for each such configuration, by the names of the
        two links.
    """
    plant, scene_graph, diagram = _build_robot_diagram(robot)
    root = diagram.CreateDefaultContext()
    context = plant.GetMyMutableContextFromRoot(root)
    inspector = scene_graph.model_inspector()
    joints = [plant.GetJointByName(name) for name in robot.joint_names]
    lower, upper = robot.position_limits.T
    distances = defaultdict[frozenset[str], list[float]](list)
    for q in np.random.default_rng(0).uniform(lower, upper, (_NUM_SAMPLES, robot.num_joints)):
        positions = np.zeros(robot.num_joints)
        positions[[joint.position_start() for joint in joints]] = q
        plant.SetPositions(context, positions)
        query = plant.get_geometry_query_input_port().Eval(context)
        smallest = defaultdict[frozenset[str], float](lambda: _ADJACENT_DISTANCE)
        for pair in query.ComputeSignedDistancePairwiseClosestPoints(_ADJACENT_DISTANCE):
            frames = [inspector.GetFrameId(geometry) for geometry in (pair.id_A, pair.id_B)]
            names = frozenset(plant.GetBodyFromFrameId(frame).name() for frame in frames)
            smallest[names] = min(smallest[names], pair.distance)
        for names, distance in smallest.items():
            distances[names].append(distance)
    return distances
