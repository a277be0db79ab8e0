"""A robot in a Drake plant: its model on its base, motors, and which collisions are left out.

Frames: T the support, which is the world; B the robot's base.
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
"""Configurations at which links two joints apart are looked at."""
_ADJACENT_DISTANCE = 0.01
"""Outlines that are no further apart are next to each other [m]."""
_MAX_STATIONARY_RADIUS = 0.25
"""A link that the first joint turns, and that reaches no further from its axis, stays in place [m]."""
PEDESTAL_NAME = "pedestal"
"""Name of the box under the base."""


def add_robot(plant: MultibodyPlant, robot: RobotModel, *, visuals: bool) -> ModelInstanceIndex:
    """Add a robot to a plant that is not finalized.

    Each joint gets an actuator, if the model has none, and the cell's limits.

    Args:
        plant: What to add to.
        robot: Which robot, and where.
        visuals: Whether cameras are to see it.
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
    """Give each joint a motor, in the order of the joints, which is that of commands to the plant."""
    motors = [plant.get_joint_actuator(index) for index in plant.GetJointActuatorIndices()]
    motors = [motor for motor in motors if motor.model_instance() == instance]
    by_joint = {
        motor.joint().name(): (motor.default_rotor_inertia(), motor.default_gear_ratio())
        for motor in motors
    }
    in_order = tuple(by_joint) == robot.joint_names
    for k, motor in enumerate(motors):
        if not in_order:
            plant.RemoveJointActuator(motor)
        elif robot.spec.limits.torque is not None:
            motor.set_effort_limit(float(robot.torque_limits[k]))
    for name, torque in (
        () if in_order else zip(robot.joint_names, robot.torque_limits.tolist(), strict=True)
    ):
        motor = plant.AddJointActuator(name, plant.GetJointByName(name, instance), torque)
        inertia, ratio = by_joint.get(name, (0.0, 1.0))
        motor.set_default_rotor_inertia(inertia)
        motor.set_default_gear_ratio(ratio)


def filter_collisions(
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    robot: RobotModel,
    instance: ModelInstanceIndex,
) -> None:
    """Leave out what cannot collide, once everything that stands in the cell is registered.

    That is `allowed_collision_pairs`, and against the surroundings what stands on the base, see
    `stationary_links`; of what else the first joint moves, the pedestal alone.
    """

    def shapes(body: RigidBody) -> GeometrySet:
        return GeometrySet(plant.GetCollisionGeometriesForBody(body))

    bodies = {name: plant.GetBodyByName(name, instance) for name in robot.link_depths}
    in_place, world = stationary_links(robot), shapes(plant.world_body())
    inspector = scene_graph.model_inspector()
    solids = plant.GetCollisionGeometriesForBody(plant.world_body())
    pedestal = GeometrySet(
        [g for g in solids if inspector.GetName(g).split("::")[-1] == PEDESTAL_NAME]
    )
    excluded = [(world, bodies[name]) for name in in_place]
    excluded += [
        (pedestal, bodies[name])
        for name, moved_by in robot.link_depths.items()
        if moved_by == 1 and name not in in_place
    ]
    excluded += [
        (shapes(bodies[first]), bodies[second]) for first, second in allowed_collision_pairs(robot)
    ]
    filters = scene_graph.collision_filter_manager()
    for first, second in excluded:
        filters.Apply(CollisionFilterDeclaration().ExcludeBetween(first, shapes(second)))


@lru_cache(maxsize=32)
def stationary_links(robot: RobotModel) -> tuple[str, ...]:
    """Return the links that stay where they are: no joint moves them, or the first turns them and
    they do not reach out.
    """
    plant, scene_graph, diagram = _build_robot_diagram(robot)
    root = diagram.CreateDefaultContext()
    query = scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(root))
    X_TJ = robot.X_TB.GetAsMatrix4() @ robot.chain.joint_frames(np.zeros(robot.num_joints))[0]
    p_TJ, axis_T = X_TJ[:3, 3], X_TJ[:3, 2]

    def reach(name: str) -> float:
        """From the first joint's axis, in any position of that joint [m]."""
        found = 0.0
        for geometry in plant.GetCollisionGeometriesForBody(plant.GetBodyByName(name)):
            box = query.inspector().GetObbInGeometryFrame(geometry)
            if box is None:
                return np.inf
            X_TG = query.GetPoseInWorld(geometry) @ box.pose()
            corners = [X_TG @ (box.half_width() * signs) for signs in product((-1, 1), repeat=3)]
            away = np.cross(np.array(corners) - p_TJ, axis_T)
            found = max(found, float(np.linalg.norm(away, axis=1).max()))
        return found

    turns = bool(robot.chain.revolute[0])
    moved = robot.link_depths.items()
    return tuple(
        name
        for name, by in moved
        if by == 0 or (by == 1 and turns and reach(name) < _MAX_STATIONARY_RADIUS)
    )


@lru_cache(maxsize=32)
def allowed_collision_pairs(robot: RobotModel) -> tuple[tuple[str, str], ...]:
    """Return pairs of links that are not checked for collision with each other.

    Those are neighbors, and links two joints apart of which the outlines overlap in no configuration,
    or are next to each other in most: the capsules meet there, and the links do not (classes "never"
    and "default" of MoveIt's self-collision matrix).
    """
    pairs = list(combinations(robot.link_depths, 2))
    between = {pair: abs(robot.link_depths[pair[0]] - robot.link_depths[pair[1]]) for pair in pairs}
    distances = _sample_link_distances(robot)
    found = [pair for pair in pairs if between[pair] <= 1]
    for pair in pairs:
        near = np.array(distances[frozenset(pair)])
        if between[pair] == 2 and (not (near < 0).any() or len(near) > _NUM_SAMPLES / 2):
            found.append(pair)
    return tuple(found)


def _build_robot_diagram(robot: RobotModel) -> tuple[MultibodyPlant, SceneGraph, Diagram]:
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0)
    add_robot(plant, robot, visuals=False)
    plant.Finalize()
    return plant, scene_graph, builder.Build()


def _sample_link_distances(robot: RobotModel) -> dict[frozenset[str], list[float]]:
    """Return distances of two links, where less than `_NEXT`, in random configurations."""
    plant, scene_graph, diagram = _build_robot_diagram(robot)
    root = diagram.CreateDefaultContext()
    context = plant.GetMyMutableContextFromRoot(root)
    inspector = scene_graph.model_inspector()
    joints = [plant.GetJointByName(name) for name in robot.joint_names]
    lower, upper = robot.position_limits.T
    found = defaultdict[frozenset[str], list[float]](list)
    for q in np.random.default_rng(0).uniform(lower, upper, (_NUM_SAMPLES, robot.num_joints)):
        positions = np.zeros(robot.num_joints)
        positions[[joint.position_start() for joint in joints]] = q
        plant.SetPositions(context, positions)
        query = plant.get_geometry_query_input_port().Eval(context)
        least = defaultdict[frozenset[str], float](lambda: _ADJACENT_DISTANCE)
        for pair in query.ComputeSignedDistancePairwiseClosestPoints(_ADJACENT_DISTANCE):
            frames = [inspector.GetFrameId(geometry) for geometry in (pair.id_A, pair.id_B)]
            names = frozenset(plant.GetBodyFromFrameId(frame).name() for frame in frames)
            least[names] = min(least[names], pair.distance)
        for names, distance in least.items():
            found[names].append(distance)
    return found
