"""Export of a scene, and of its work cell, as a USD stage.

Bodies, collision geometry, masses, joints and drives are those of the schema UsdPhysics.

    /scene/tray, /scene/cell/...             colliders that do not move
    /scene/objects/...                       rigid bodies
    /scene/arm/robot/..., .../gripper/...    links of an articulation
    /scene/arm/joints/...                    its joints, with drives
    /scene/cameras/...                       cameras
    /classes/...                             visual meshes of the objects' classes

The names of prims have letters, digits and _ only; the display name is that of the scene or cell.
"""

# usd-core is typed in part only, and trimesh, too.
# mypy: allow-untyped-calls

import math
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdPhysics, UsdShade, Vt
from pydrake.geometry import Box, Capsule, Convex, Cylinder, Ellipsoid, Mesh, Shape, Sphere
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial.transform import Rotation

from drake_clutter.assets.contact_properties import SURFACE_FRICTION
from drake_clutter.catalog import ObjectClass
from drake_clutter.catalog import Shape as ObjectShape
from drake_clutter.cell.payload_limits import GRAVITY
from drake_clutter.cell.support import Support
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.export.cell_model import (
    CellBody,
    CellCamera,
    CellJoint,
    CellModel,
)
from drake_clutter.export.cell_reader import read_cell_model
from drake_clutter.export.model_parts import (
    Inertial,
    classes_in_scene,
    load_inertial,
    load_shape_mesh,
    load_visual,
    support_boxes,
)
from drake_clutter.scenes.scene import TRAY, Scene, SceneObject
from drake_clutter.simulation.scene_plant import rigid_transform

_VERTICAL_APERTURE = 20.0
"""Height of the image of a camera [tenths of a unit]; only its ratio to the focal length counts."""
_R_CAMERA = RotationMatrix.MakeXRotation(math.pi)
"""Orientation in C of USD's camera frame, which looks along -z with y up."""


def write_usd(scene: Scene, folder: Path, cell: WorkCell | None) -> Path:
    """Write `scene.usda` and the texture of each class.

    Args:
        scene: Scene.
        folder: Folder to write to.
        cell: Work cell to write beside the scene; None for the scene alone, on a table.

    Returns:
        Path of `scene.usda`.
    """
    path = folder / "scene.usda"
    writer = _StageWriter(path)
    for object_class in classes_in_scene(scene):
        writer.add_class(object_class)
    writer.add_tray(scene.support, table=cell is None)
    for scene_object in scene.objects:
        writer.add_object(scene_object)
    if cell is not None:
        writer.add_cell(read_cell_model(cell))
    writer.stage.GetRootLayer().Save()
    return path


class _StageWriter:
    """Adds prims to a new stage."""

    def __init__(self, path: Path) -> None:
        self._folder = path.parent
        self.stage = Usd.Stage.CreateNew(str(path))
        UsdGeom.SetStageUpAxis(self.stage, UsdGeom.Tokens.z)
        UsdGeom.SetStageMetersPerUnit(self.stage, 1.0)
        UsdPhysics.SetStageKilogramsPerUnit(self.stage, 1.0)
        self._paths = dict[tuple[Sdf.Path, str], Sdf.Path]()
        self._materials = dict[float, UsdShade.Material]()
        root = UsdGeom.Xform.Define(self.stage, "/scene").GetPrim()
        self._root = root.GetPath()
        self.stage.SetDefaultPrim(root)
        physics = UsdPhysics.Scene.Define(self.stage, self._root.AppendChild("physics"))
        physics.CreateGravityDirectionAttr(Gf.Vec3f(0, 0, -1))
        physics.CreateGravityMagnitudeAttr(GRAVITY)
        self._classes = self.stage.CreateClassPrim("/classes").GetPath()

    def _new_path(self, parent: Sdf.Path, name: str) -> Sdf.Path:
        """Return a path for a name that is unique below its parent."""
        identifier = Tf.MakeValidIdentifier(name)
        path = parent.AppendChild(identifier)
        taken = self._paths.values()
        number = 1
        while path in taken:
            number += 1
            path = parent.AppendChild(f"{identifier}_{number}")
        self._paths[parent, name] = path
        return path

    def _add_xform(self, parent: Sdf.Path, name: str, X: RigidTransform | None = None) -> Usd.Prim:
        """Add a frame, named by its display name, and return its prim."""
        xform = UsdGeom.Xform.Define(self.stage, self._new_path(parent, name))
        prim = xform.GetPrim()
        if prim.GetName() != name:
            prim.SetDisplayName(name)
        if X is not None:
            _set_pose(xform, X)
        return prim

    def add_class(self, object_class: ObjectClass) -> None:
        """Add the visual mesh of a class, and write its texture."""
        mesh = load_visual(object_class)
        texture = f"{object_class.name}/label.png"
        (self._folder / object_class.name).mkdir()
        mesh.visual.material.baseColorTexture.convert("RGB").save(self._folder / texture)
        path = self._new_path(self._classes, object_class.name)
        geometry = _define_mesh(self.stage, path, mesh)
        coordinates = UsdGeom.PrimvarsAPI(geometry).CreatePrimvar(
            "st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex
        )
        coordinates.Set(Vt.Vec2fArray.FromNumpy(np.asarray(mesh.visual.uv, np.float32)))
        material = UsdShade.Material.Define(self.stage, path.AppendChild("material"))
        surface = UsdShade.Shader.Define(self.stage, path.AppendPath("material/surface"))
        surface.CreateIdAttr("UsdPreviewSurface")
        surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(0.8)
        image = UsdShade.Shader.Define(self.stage, path.AppendPath("material/image"))
        image.CreateIdAttr("UsdUVTexture")
        image.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(Sdf.AssetPath(f"./{texture}"))
        reader = UsdShade.Shader.Define(self.stage, path.AppendPath("material/coordinates"))
        reader.CreateIdAttr("UsdPrimvarReader_float2")
        reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
        result = reader.CreateOutput("result", Sdf.ValueTypeNames.Float2)
        image.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(result)
        color = image.CreateOutput("rgb", Sdf.ValueTypeNames.Float3)
        surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(color)
        output = surface.CreateOutput("surface", Sdf.ValueTypeNames.Token)
        material.CreateSurfaceOutput().ConnectToSource(output)
        UsdShade.MaterialBindingAPI.Apply(geometry.GetPrim()).Bind(material)

    def add_tray(self, support: Support, *, table: bool) -> None:
        """Add the support, and optionally the table under it, as fixed colliders."""
        tray = self._add_xform(self._root, TRAY).GetPath()
        for box in support_boxes(support, table=table):
            shape = Box(*box.size)
            geometry = self._add_shape(tray, box.name, shape, RigidTransform(box.p_TG))
            _set_color(geometry, box.color.tolist())
            self._make_collider(geometry, SURFACE_FRICTION)

    def add_object(self, scene_object: SceneObject) -> None:
        """Add an object as a rigid body."""
        object_class = scene_object.object_class
        objects = self._scope(self._root, "objects")
        body = self._add_xform(objects, scene_object.name, rigid_transform(scene_object.X_TO))
        UsdPhysics.RigidBodyAPI.Apply(body)
        _set_mass(body, load_inertial(object_class))
        visual = self.stage.DefinePrim(body.GetPath().AppendChild("visual"), "Mesh")
        source = self._paths[self._classes, object_class.name]
        visual.GetReferences().AddInternalReference(source)
        for k, shape in enumerate(_object_shapes(object_class)):
            geometry = self._add_shape(body.GetPath(), f"collision_{k}", shape, RigidTransform())
            UsdGeom.Imageable(geometry).CreatePurposeAttr(UsdGeom.Tokens.guide)
            self._make_collider(geometry, SURFACE_FRICTION)

    def add_cell(self, model: CellModel) -> None:
        """Add everything of a cell but its support."""
        arm = self._add_xform(self._root, "arm")
        UsdPhysics.ArticulationRootAPI.Apply(arm)
        scopes = {
            "cell": self._scope(self._root, "cell"),
            "robot": self._scope(arm.GetPath(), "robot"),
            "gripper": self._scope(arm.GetPath(), "gripper"),
        }
        prims = dict[str, Usd.Prim]()
        for body in model.bodies:
            part, _, name = body.name.partition("/")
            prims[body.name] = self._add_body(scopes[part], name, body, is_moving=part != "cell")
        joints = self._scope(arm.GetPath(), "joints")
        for body in model.bodies:
            if not body.name.startswith("cell/"):
                self._add_joint(joints, body, prims)
        for frame in model.frames:
            name = f"frame_{frame.name.partition('/')[2]}"
            self._add_xform(prims[frame.body].GetPath(), name, frame.X_BF)
        for first, second in model.excluded:
            pairs = UsdPhysics.FilteredPairsAPI.Apply(prims[first])
            pairs.CreateFilteredPairsRel().AddTarget(prims[second].GetPath())
        scope = self._scope(self._root, "cameras")
        for camera in model.cameras:
            parent = prims[camera.body].GetPath() if camera.body else scope
            name = camera.name.replace("robot/", "camera_")
            _define_camera(self.stage, self._new_path(parent, name), camera)

    def _scope(self, parent: Sdf.Path, name: str) -> Sdf.Path:
        """Return the path of a frame that only groups prims; it is added once."""
        known = self._paths.get((parent, name))
        return known or self._add_xform(parent, name).GetPath()

    def _add_body(
        self, parent: Sdf.Path, name: str, body: CellBody, *, is_moving: bool
    ) -> Usd.Prim:
        """Add a body of a cell and return its prim."""
        prim = self._add_xform(parent, name, body.X_TB)
        if is_moving:
            UsdPhysics.RigidBodyAPI.Apply(prim)
            if body.inertial is not None:
                _set_mass(prim, body.inertial)
        for k, visual in enumerate(body.visuals):
            path = prim.GetPath()
            _set_color(
                self._add_shape(path, f"visual_{k}", visual.shape, visual.X_BG), visual.color
            )
        for k, collision in enumerate(body.collisions):
            geometry = self._add_shape(
                prim.GetPath(), f"collision_{k}", collision.shape, collision.X_BG
            )
            UsdGeom.Imageable(geometry).CreatePurposeAttr(UsdGeom.Tokens.guide)
            self._make_collider(geometry, collision.friction)
        return prim

    def _add_joint(self, parent: Sdf.Path, body: CellBody, prims: dict[str, Usd.Prim]) -> None:
        """Add the joint between a body and its parent."""
        joint = body.joint
        if joint is None:
            path = self._new_path(parent, f"{body.name.partition('/')[2]}_fixed")
            prim = UsdPhysics.FixedJoint.Define(self.stage, path)
            X_BJ = RigidTransform()
        else:
            path = self._new_path(parent, joint.name.partition("/")[2])
            kind = UsdPhysics.RevoluteJoint if joint.is_revolute else UsdPhysics.PrismaticJoint
            prim = kind.Define(self.stage, path)
            _set_motion(prim, joint)
            X_BJ = RigidTransform(RotationMatrix.MakeFromOneVector(joint.axis_B, 2), joint.p_B)
        if body.parent:
            prim.CreateBody0Rel().SetTargets([prims[body.parent].GetPath()])
        prim.CreateBody1Rel().SetTargets([prims[body.name].GetPath()])
        X_PJ = body.X_PB @ X_BJ
        prim.CreateLocalPos0Attr(Gf.Vec3f(*X_PJ.translation()))
        prim.CreateLocalRot0Attr(Gf.Quatf(*X_PJ.rotation().ToQuaternion().wxyz()))
        prim.CreateLocalPos1Attr(Gf.Vec3f(*X_BJ.translation()))
        prim.CreateLocalRot1Attr(Gf.Quatf(*X_BJ.rotation().ToQuaternion().wxyz()))

    def _add_shape(
        self, parent: Sdf.Path, name: str, shape: Shape, X_BG: RigidTransform
    ) -> UsdGeom.Gprim:
        """Add a shape below a body."""
        path = self._new_path(parent, name)
        scale: tuple[float, ...] | None = None
        if isinstance(shape, Box):
            geometry = UsdGeom.Cube.Define(self.stage, path)
            geometry.CreateSizeAttr(1.0)
            geometry.CreateExtentAttr([(-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)])
            scale = tuple(shape.size().tolist())
        elif isinstance(shape, (Cylinder, Capsule)):
            kind = UsdGeom.Cylinder if isinstance(shape, Cylinder) else UsdGeom.Capsule
            geometry = kind.Define(self.stage, path)
            geometry.CreateAxisAttr(UsdGeom.Tokens.z)
            geometry.CreateRadiusAttr(shape.radius())
            geometry.CreateHeightAttr(shape.length())
            r, h = shape.radius(), shape.length() / 2
            h += 0.0 if isinstance(shape, Cylinder) else r
            geometry.CreateExtentAttr([(-r, -r, -h), (r, r, h)])
        elif isinstance(shape, (Sphere, Ellipsoid)):
            geometry = UsdGeom.Sphere.Define(self.stage, path)
            radius = shape.radius() if isinstance(shape, Sphere) else 1.0
            geometry.CreateRadiusAttr(radius)
            geometry.CreateExtentAttr([(-radius,) * 3, (radius,) * 3])
            scale = None if isinstance(shape, Sphere) else (shape.a(), shape.b(), shape.c())
        else:
            assert isinstance(shape, (Mesh, Convex)), f"a {type(shape).__name__} in a cell"
            geometry = _define_mesh(self.stage, path, load_shape_mesh(shape))
        _set_pose(geometry, X_BG)
        if scale is not None:
            geometry.AddScaleOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*scale))
        return geometry

    def _make_collider(self, geometry: UsdGeom.Gprim, friction: float) -> None:
        """Make a geometry collide."""
        prim = geometry.GetPrim()
        UsdPhysics.CollisionAPI.Apply(prim)
        if prim.IsA(UsdGeom.Mesh):
            approximation = UsdPhysics.MeshCollisionAPI.Apply(prim)
            approximation.CreateApproximationAttr(UsdPhysics.Tokens.convexHull)
        binding = UsdShade.MaterialBindingAPI.Apply(prim)
        binding.Bind(self._material(friction), materialPurpose="physics")

    def _material(self, friction: float) -> UsdShade.Material:
        """Return the physics material with a coefficient of friction."""
        if friction not in self._materials:
            scope = self._scope(self._root, "materials")
            path = self._new_path(scope, f"friction_{friction:g}")
            material = UsdShade.Material.Define(self.stage, path)
            properties = UsdPhysics.MaterialAPI.Apply(material.GetPrim())
            properties.CreateStaticFrictionAttr(friction)
            properties.CreateDynamicFrictionAttr(friction)
            properties.CreateRestitutionAttr(0.0)
            self._materials[friction] = material
        return self._materials[friction]


def _object_shapes(object_class: ObjectClass) -> list[Shape]:
    """Return the collision geometry of a class."""
    x, y, z = object_class.size
    if object_class.shape is ObjectShape.BOX:
        return [Box(x, y, z)]
    if object_class.shape is ObjectShape.CYLINDER:
        return [Cylinder(x / 2, z)]
    return [Convex(str(path)) for path in sorted(object_class.folder.glob("convex_*.obj"))]


def _set_pose(geometry: UsdGeom.Xformable, X: RigidTransform) -> None:
    quaternion = Gf.Quatd(*X.rotation().ToQuaternion().wxyz())
    geometry.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*X.translation()))
    geometry.AddOrientOp(UsdGeom.XformOp.PrecisionDouble).Set(quaternion)


def _set_color(geometry: UsdGeom.Gprim, color: Any) -> None:
    """Set red, green, blue and alpha."""
    *rgb, alpha = color
    geometry.CreateDisplayColorAttr([Gf.Vec3f(*rgb)])
    geometry.CreateDisplayOpacityAttr([alpha])


def _set_mass(prim: Usd.Prim, inertial: Inertial) -> None:
    """Set mass, center of mass and principal moments of inertia."""
    xx, yy, zz, xy, xz, yz = inertial.inertia
    moments, axes = np.linalg.eigh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    quaternion = Rotation.from_matrix(axes).as_quat(canonical=True, scalar_first=True)
    properties = UsdPhysics.MassAPI.Apply(prim)
    properties.CreateMassAttr(inertial.mass)
    properties.CreateCenterOfMassAttr(Gf.Vec3f(*inertial.com))
    properties.CreateDiagonalInertiaAttr(Gf.Vec3f(*moments))
    properties.CreatePrincipalAxesAttr(Gf.Quatf(*quaternion))


def _set_motion(prim: Any, joint: CellJoint) -> None:
    """Set axis, limits and drive of a joint; a spring is a drive, too."""
    prim.CreateAxisAttr(UsdPhysics.Tokens.z)
    unit = math.degrees(1) if joint.is_revolute else 1.0
    if all(math.isfinite(limit) for limit in joint.limits):
        prim.CreateLowerLimitAttr(joint.limits[0] * unit)
        prim.CreateUpperLimitAttr(joint.limits[1] * unit)
    stiffness, target = joint.spring
    damping = joint.damping
    limit = math.inf
    if joint.actuator is not None:
        stiffness, target = joint.actuator.stiffness, joint.home
        damping += joint.actuator.damping
        limit = joint.actuator.effort_limit
    if not stiffness and not damping:
        return
    kind = UsdPhysics.Tokens.angular if joint.is_revolute else UsdPhysics.Tokens.linear
    drive = UsdPhysics.DriveAPI.Apply(prim.GetPrim(), kind)
    drive.CreateTypeAttr(UsdPhysics.Tokens.force)
    drive.CreateStiffnessAttr(stiffness / unit)
    drive.CreateDampingAttr(damping / unit)
    drive.CreateTargetPositionAttr(target * unit)
    drive.CreateMaxForceAttr(limit)


def _define_mesh(stage: Usd.Stage, path: Sdf.Path, mesh: Any) -> UsdGeom.Mesh:
    """Define a triangle mesh from one of trimesh."""
    geometry = UsdGeom.Mesh.Define(stage, path)
    points = Vt.Vec3fArray.FromNumpy(np.asarray(mesh.vertices, np.float32))
    faces = np.asarray(mesh.faces, np.int32)
    geometry.CreatePointsAttr(points)
    geometry.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
    geometry.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.ravel()))
    geometry.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    geometry.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(points))
    return geometry


def _define_camera(stage: Usd.Stage, path: Sdf.Path, camera: CellCamera) -> None:
    """Define a pinhole camera."""
    prim = UsdGeom.Camera.Define(stage, path)
    _set_pose(prim, camera.X_BC @ RigidTransform(_R_CAMERA))
    width, height = camera.camera.width, camera.camera.height
    prim.CreateVerticalApertureAttr(_VERTICAL_APERTURE)
    prim.CreateHorizontalApertureAttr(_VERTICAL_APERTURE * width / height)
    prim.CreateFocalLengthAttr(_VERTICAL_APERTURE * camera.camera.focal_length / height)
    prim.CreateClippingRangeAttr(Gf.Vec2f(0.01, 100.0))
