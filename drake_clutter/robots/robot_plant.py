"""A robot in a Drake plant: its model on its base, motors, and which collisions are left out.

Frames: T the support, which is the world; B the robot's base.
"""

from collections import defaultdict
from functools import lru_cache
from itertools import combinations

import numpy as np
from pydrake.geometry import CollisionFilterDeclaration, GeometrySet, SceneGraph
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex, RigidBody
from pydrake.systems.framework import DiagramBuilder

from drake_clutter.robots.model_file import parse_model
from drake_clutter.robots.robot_model import RobotModel

_SAMPLES = 200
"""Configurations at which links two joints apart are looked at."""
_NEXT = 0.01
"""Outlines that are no further apart are next to each other [m]."""


def add_robot(plant: MultibodyPlant, robot: RobotModel, *, visuals: bool) -> ModelInstanceIndex:
    """Add a robot to a plant that is not finalized.

    Each joint gets an actuator of the joint's name, if the model has none, and the cell's limits.

    Args:
        plant: What to add to.
        robot: Which robot, and where.
        visuals: Whether cameras are to see it.
    """
    spec = robot.spec
    instance = parse_model(plant, spec.model, visuals=visuals)
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName(spec.base_link, instance), spec.X_TB)
    actuators = [plant.get_joint_actuator(index) for index in plant.GetJointActuatorIndices()]
    by_joint = {a.joint().name(): a for a in actuators if a.joint().model_instance() == instance}
    for k, name in enumerate(robot.joint_names):
        joint, torque = plant.GetJointByName(name, instance), float(robot.torque_limits[k])
        if name not in by_joint:
            plant.AddJointActuator(name, joint, torque)
        elif spec.limits.torque is not None:
            by_joint[name].set_effort_limit(torque)
        if spec.limits.position is not None:
            lower, upper = robot.position_limits[k]
            joint.set_position_limits([lower], [upper])
    return instance


def filter_collisions(
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    robot: RobotModel,
    instance: ModelInstanceIndex,
) -> None:
    """Leave out what cannot collide, once everything that stands in the cell is registered.

    That is `unmeeting_links`, and what the first joint turns in place against the surroundings.
    """

    def shapes(body: RigidBody) -> GeometrySet:
        return GeometrySet(plant.GetCollisionGeometriesForBody(body))

    bodies = {name: plant.GetBodyByName(name, instance) for name in robot.links}
    on_base = [bodies[name] for name, moved_by in robot.links.items() if moved_by <= 1]
    excluded = [(plant.world_body(), body) for body in on_base]
    excluded += [(bodies[first], bodies[second]) for first, second in unmeeting_links(robot)]
    filters = scene_graph.collision_filter_manager()
    for first, second in excluded:
        filters.Apply(CollisionFilterDeclaration().ExcludeBetween(shapes(first), shapes(second)))


@lru_cache(maxsize=32)
def unmeeting_links(robot: RobotModel) -> tuple[tuple[str, str], ...]:
    """Return pairs of links that are not checked for collision with each other.

    Those are neighbors, and links two joints apart of which the outlines overlap in no configuration,
    or are next to each other in most: the capsules meet there, and the links do not (classes "never"
    and "default" of MoveIt's self-collision matrix).
    """
    pairs = list(combinations(robot.links, 2))
    between = {pair: abs(robot.links[pair[0]] - robot.links[pair[1]]) for pair in pairs}
    distances = _distances(robot)
    found = [pair for pair in pairs if between[pair] <= 1]
    for pair in pairs:
        near = np.array(distances[frozenset(pair)])
        if between[pair] == 2 and (not (near < 0).any() or len(near) > _SAMPLES / 2):
            found.append(pair)
    return tuple(found)


def _distances(robot: RobotModel) -> dict[frozenset[str], list[float]]:
    """Return distances of two links, where less than `_NEXT`, in random configurations."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0)
    instance = add_robot(plant, robot, visuals=False)
    plant.Finalize()
    diagram = builder.Build()
    root = diagram.CreateDefaultContext()
    context = plant.GetMyMutableContextFromRoot(root)
    inspector = scene_graph.model_inspector()
    joints = [plant.GetJointByName(name, instance) for name in robot.joint_names]
    lower, upper = robot.position_limits.T
    found = defaultdict[frozenset[str], list[float]](list)
    for q in np.random.default_rng(0).uniform(lower, upper, (_SAMPLES, robot.num_joints)):
        positions = np.zeros(robot.num_joints)
        positions[[joint.position_start() for joint in joints]] = q
        plant.SetPositions(context, positions)
        query = plant.get_geometry_query_input_port().Eval(context)
        least = defaultdict[frozenset[str], float](lambda: _NEXT)
        for pair in query.ComputeSignedDistancePairwiseClosestPoints(_NEXT):
            frames = [inspector.GetFrameId(geometry) for geometry in (pair.id_A, pair.id_B)]
            names = frozenset(plant.GetBodyFromFrameId(frame).name() for frame in frames)
            least[names] = min(least[names], pair.distance)
        for names, distance in least.items():
            found[names].append(distance)
    return found
