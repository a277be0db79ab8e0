"""Bodies, joints, cameras and actuators of a work cell in an MJCF model."""

import math
from collections.abc import Mapping
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement

from pydrake.geometry import Box, Capsule, Convex, Cylinder, Ellipsoid, Mesh, Shape, Sphere
from pydrake.math import RigidTransform, RotationMatrix

from drake_clutter.export.cell_model import CellBody, CellCamera, CellJoint, CellModel
from drake_clutter.export.model_parts import format_numbers, write_shape_mesh

_MESH_FOLDER = "cell_meshes"
"""Folder of the meshes of robots and fixtures."""
_R_CAMERA = RotationMatrix.MakeXRotation(math.pi)
"""Orientation in C of MuJoCo's camera frame, which looks along -z with y up."""


class CellWriter:
    """Adds a work cell to the elements of an MJCF model."""

    def __init__(self, model: CellModel, root: Element, folder: Path) -> None:
        """Create a writer.

        Args:
            model: Cell.
            root: Element `mujoco` with the children `option`, `asset` and `worldbody`.
            folder: Folder of the document.
        """
        self._model = model
        self._root = root
        self._folder = folder
        self._num_meshes = 0

    def add(self) -> None:
        """Add everything but the keyframe, which needs all bodies of the document."""
        # Position control is stiffer than the time step allows without implicit damping.
        self._child("option").set("integrator", "implicitfast")
        worldbody = self._child("worldbody")
        self._add_visual_size()
        elements = {"": worldbody}
        for body in self._model.bodies:
            elements[body.name] = self._add_body(elements[body.parent], body)
        for frame in self._model.frames:
            attributes = {"name": frame.name} | _pose_attributes(frame.X_BF)
            SubElement(elements[frame.body], "site", attributes)
        for camera in self._model.cameras:
            _add_camera(elements[camera.body], camera)
        contact = SubElement(self._root, "contact")
        for first, second in self._model.excluded:
            SubElement(contact, "exclude", body1=first, body2=second)
        if self._model.couplings:
            equality = SubElement(self._root, "equality")
            for coupling in self._model.couplings:
                SubElement(
                    equality,
                    "joint",
                    joint1=coupling.joint,
                    joint2=coupling.other,
                    polycoef=format_numbers([coupling.offset, coupling.multiplier, 0, 0, 0]),
                )
        self._add_actuators()

    def add_home(self, objects: Mapping[str, RigidTransform]) -> None:
        """Add the keyframe `home`.

        The control carries the weight of the arm, which rests there.

        Args:
            objects: Poses of the free bodies, by the names of their joints.
        """
        joints = {body.joint.name: body.joint for body in self._model.bodies if body.joint}
        qpos = list[float]()
        for element in self._root.iter():  # in the order of MuJoCo's joints
            if element.tag == "freejoint":
                X_TO = objects[element.get("name", "")]
                qpos += [*X_TO.translation(), *X_TO.rotation().ToQuaternion().wxyz()]
            elif element.tag == "joint" and "axis" in element.attrib:
                qpos.append(joints[element.get("name", "")].home)
        control = [
            joint.home + joint.actuator.gravity_effort / joint.actuator.stiffness
            for joint in joints.values()
            if joint.actuator
        ]
        keyframe = SubElement(self._root, "keyframe")
        SubElement(
            keyframe, "key", name="home", qpos=format_numbers(qpos), ctrl=format_numbers(control)
        )

    def _child(self, tag: str) -> Element:
        """Return a child of the root."""
        element = self._root.find(tag)
        assert element is not None
        return element

    def _add_visual_size(self) -> None:
        """Make the buffer of offscreen rendering as large as the largest image."""
        cameras = [entry.camera for entry in self._model.cameras]
        visual = SubElement(self._root, "visual")
        SubElement(
            visual,
            "global",
            offwidth=str(max(camera.width for camera in cameras)),
            offheight=str(max(camera.height for camera in cameras)),
        )

    def _add_body(self, parent: Element, body: CellBody) -> Element:
        element = SubElement(parent, "body", {"name": body.name} | _pose_attributes(body.X_PB))
        if body.joint is not None:
            _add_joint(element, body.joint)
        if body.inertial is not None:
            SubElement(
                element,
                "inertial",
                pos=format_numbers(body.inertial.com),
                mass=repr(body.inertial.mass),
                fullinertia=format_numbers(body.inertial.inertia),
            )
        for visual in body.visuals:
            SubElement(
                element,
                "geom",
                {"class": "visual", "rgba": format_numbers(visual.color)}
                | _pose_attributes(visual.X_BG)
                | self._shape_attributes(visual.shape),
            )
        for collision in body.collisions:
            geometry = SubElement(
                element,
                "geom",
                {"class": "collision"}
                | _pose_attributes(collision.X_BG)
                | self._shape_attributes(collision.shape),
            )
            geometry.set("friction", repr(collision.friction))
        return element

    def _shape_attributes(self, shape: Shape) -> dict[str, str]:
        """Return type and size of a geom; a mesh is written and added to the assets."""
        if isinstance(shape, (Mesh, Convex)):
            name = f"{_MESH_FOLDER}/{self._num_meshes}"
            self._num_meshes += 1
            (self._folder / _MESH_FOLDER).mkdir(exist_ok=True)
            write_shape_mesh(shape, self._folder / f"{name}.obj")
            SubElement(self._child("asset"), "mesh", name=name, file=f"{name}.obj")
            return {"type": "mesh", "mesh": name}
        kind, size = _primitive_size(shape)
        return {"type": kind, "size": format_numbers(size)}

    def _add_actuators(self) -> None:
        """Add a position actuator for each actuated joint."""
        actuators = SubElement(self._root, "actuator")
        for body in self._model.bodies:
            if body.joint is None or body.joint.actuator is None:
                continue
            actuator = body.joint.actuator
            element = SubElement(
                actuators,
                "position",
                name=body.joint.name,
                joint=body.joint.name,
                kp=repr(actuator.stiffness),
                kv=repr(actuator.damping),
            )
            if math.isfinite(actuator.effort_limit):
                limits = [-actuator.effort_limit, actuator.effort_limit]
                element.set("forcerange", format_numbers(limits))


def _primitive_size(shape: Shape) -> tuple[str, list[float]]:
    """Return type and size of a geom that is not a mesh."""
    if isinstance(shape, Box):
        return "box", (shape.size() / 2).tolist()
    if isinstance(shape, Cylinder):
        return "cylinder", [shape.radius(), shape.length() / 2]
    if isinstance(shape, Capsule):
        return "capsule", [shape.radius(), shape.length() / 2]
    if isinstance(shape, Sphere):
        return "sphere", [shape.radius()]
    assert isinstance(shape, Ellipsoid), f"a {type(shape).__name__} in a robot or fixture"
    return "ellipsoid", [shape.a(), shape.b(), shape.c()]


def _pose_attributes(X: RigidTransform) -> dict[str, str]:
    """Return position and quaternion as attributes."""
    return {
        "pos": format_numbers(X.translation()),
        "quat": format_numbers(X.rotation().ToQuaternion().wxyz()),
    }


def _add_joint(body: Element, joint: CellJoint) -> None:
    element = SubElement(
        body,
        "joint",
        name=joint.name,
        type="hinge" if joint.is_revolute else "slide",
        pos=format_numbers(joint.p_B),
        axis=format_numbers(joint.axis_B),
        damping=repr(joint.damping),
        armature=repr(joint.armature),
    )
    if all(math.isfinite(limit) for limit in joint.limits):
        element.set("range", format_numbers(joint.limits))
    stiffness, position = joint.spring
    if stiffness:
        element.set("stiffness", repr(stiffness))
        element.set("springref", repr(position))


def _add_camera(body: Element, camera: CellCamera) -> None:
    attributes = {
        "name": camera.name,
        "fovy": repr(camera.camera.fov_y_deg),
        "resolution": f"{camera.camera.width} {camera.camera.height}",
    }
    X_BM = camera.X_BC @ RigidTransform(_R_CAMERA)
    SubElement(body, "camera", attributes | _pose_attributes(X_BM))
