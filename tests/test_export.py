"""Exported folders can be moved, and are read back by the target programs."""

import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pybullet
import pytest
import trimesh
from conftest import CATALOG, DEFAULT_CELL, resting, scene_of
from numpy.typing import NDArray
from PIL import Image
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from scipy.spatial.transform import Rotation

from benchmarks.exported_stability import MAX_DISPLACEMENT, simulate_mujoco, simulate_pybullet
from drake_clutter.assets import build_assets
from drake_clutter.assets.contact_properties import ROLLING_FRICTION, SURFACE_FRICTION
from drake_clutter.catalog import ObjectClass, Shape, load_catalog
from drake_clutter.config import ClutterConfig
from drake_clutter.export import ExportFormat, export_scene
from drake_clutter.export.model_parts import load_inertial, load_visual
from drake_clutter.export.sdf_writer import PYBULLET_FILE
from drake_clutter.files import InputError
from drake_clutter.grammar import Orientation
from drake_clutter.scenes.interfaces import InstabilityReason
from drake_clutter.scenes.scene import Pose, Scene, SceneObject
from drake_clutter.scenes.scene_dataset import load_scene_dataset
from drake_clutter.simulation.scene_plant import rigid_transform
from drake_clutter.simulation.settle import settle
from drake_clutter.station.clutter_station import ClutterStation
from training.script import SCENES

EXAMPLE = Path(__file__).parent.parent / "examples" / "custom_class"
MAIN_FILES = {
    ExportFormat.DMD: "scene.dmd.yaml",
    ExportFormat.SDF: "scene.sdf",
    ExportFormat.MJCF: "scene.xml",
    ExportFormat.GLB: "scene.glb",
    ExportFormat.USD: "scene.usda",
}
REFERENCE = re.compile(
    r'<uri>(.*?)</uri>|file="(.*?)"|^mtllib (.*)$|^map_Kd (.*)$|^ *file: (.*)$'
    r"|asset inputs:file = @(.*?)@",
    re.MULTILINE,
)
BULLET = 1e-5


@pytest.fixture(scope="module")
def mug(tmp_path_factory: pytest.TempPathFactory) -> ObjectClass:
    """Return the example's mesh class, whose origin is not its center of mass."""
    folder = tmp_path_factory.mktemp("user") / "custom_class"
    folder.mkdir()
    for name in ("catalog.yaml", "mug.stl"):
        shutil.copy(EXAMPLE / name, folder)
    build_assets(folder)
    return load_catalog(folder).classes["mug"]


@pytest.fixture(scope="module")
def scene(mug: ObjectClass) -> Scene:
    """Return a box on a can (its pitch is a right angle), another can, a marker and a mug."""
    can = resting("tomato_soup_can", Orientation.UPRIGHT_0, (0.1, 0.1))
    box = resting("sugar_box", xy=(0.1, 0.1), floor=can.top_height)
    tilted = Pose.from_rotation(
        Rotation.from_euler("zyx", [0.4, np.pi / 2, 0.0]).as_matrix(), (-0.1, -0.1, 0.009)
    )
    turned = Pose.from_rotation(
        Rotation.from_euler("z", 2.0).as_matrix(), (0.2, -0.15, mug.size[2] / 2)
    )
    return scene_of(
        can,
        resting("tomato_soup_can", Orientation.UPRIGHT_0, (-0.1, 0.15), name="another can-2.1 ü"),
        box,
        SceneObject("marker", resting("large_marker").object_class, tilted),
        SceneObject("mug", mug, turned),
        side=0.65,
    )


@pytest.fixture(scope="module", params=ExportFormat, ids=lambda format: format.value)
def exported(
    request: pytest.FixtureRequest, scene: Scene, tmp_path_factory: pytest.TempPathFactory
) -> tuple[ExportFormat, Path]:
    """Return the format and main file of an export that was moved afterwards."""
    format: ExportFormat = request.param
    out = tmp_path_factory.mktemp("export") / "before"
    out.mkdir()
    main_file = export_scene(scene, format, out)
    assert main_file == out / MAIN_FILES[format]
    after = tmp_path_factory.mktemp("moved") / "after"
    shutil.move(out, after)
    return format, after / main_file.name


def matrix_of(pose: Pose) -> NDArray[np.float64]:
    """Return a pose as a matrix (4, 4)."""
    return np.asarray(rigid_transform(pose).GetAsMatrix4())


def check(
    scene: Scene, name: str, mass: float | None, X_TO: NDArray[np.float64], tolerance: float = 1e-6
) -> None:
    """Assert that mass [kg] and pose (4, 4) equal those of the scene [m, rad]."""
    assert pytest.approx(matrix_of(scene[name].X_TO), abs=tolerance) == X_TO, name
    assert mass is None or mass == pytest.approx(scene[name].object_class.mass, abs=1e-6), name


def check_in_drake(scene: Scene, main_file: Path, package_xml: Path | None) -> None:
    plant, scene_graph = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.001)
    parser = Parser(plant)
    parser.SetStrictParsing()
    if package_xml:
        parser.package_map().AddPackageXml(str(package_xml))
    parser.AddModels(str(main_file))
    plant.Finalize()
    assert plant.num_bodies() == 2 + len(scene.objects)  # the world, the tray
    assert plant.num_positions() == 7 * len(scene.objects)
    context = plant.CreateDefaultContext()
    for name in scene.names:
        body = plant.GetBodyByName("body", plant.GetModelInstanceByName(name))
        check(scene, name, body.default_mass(), body.EvalPoseInWorld(context).GetAsMatrix4())
        inspector = scene_graph.model_inspector()
        for geometry in plant.GetCollisionGeometriesForBody(body):
            friction = inspector.GetProximityProperties(geometry).GetProperty(
                "material", "coulomb_friction"
            )
            assert friction.static_friction() == friction.dynamic_friction() == SURFACE_FRICTION
            assert inspector.GetProximityProperties(geometry).HasProperty(
                "hydroelastic", "hydroelastic_modulus"
            )


@pytest.fixture
def bullet() -> Iterator[int]:
    client = pybullet.connect(pybullet.DIRECT)
    yield client
    pybullet.disconnect(client)


def check_in_pybullet(scene: Scene, main_file: Path, client: int) -> None:
    bodies = pybullet.loadSDF(str(main_file.with_name(PYBULLET_FILE)), physicsClientId=client)
    names = [pybullet.getBodyInfo(body, physicsClientId=client)[1].decode() for body in bodies]
    assert names == ["tray", *scene.names]
    assert pybullet.getDynamicsInfo(bodies[0], -1, physicsClientId=client)[0] == 0  # it is static
    for body, name in list(zip(bodies, names, strict=True))[1:]:
        dynamics = pybullet.getDynamicsInfo(body, -1, physicsClientId=client)
        X_OI, X_TI = np.eye(4), np.eye(4)
        for X, (p, q) in (
            (X_OI, dynamics[3:5]),
            (X_TI, pybullet.getBasePositionAndOrientation(body, physicsClientId=client)),
        ):
            X[:3, :3], X[:3, 3] = Rotation.from_quat(q).as_matrix(), p
        check(scene, name, dynamics[0], X_TI @ np.linalg.inv(X_OI), BULLET)
        # PyBullet multiplies friction, and rolling friction by the other body's friction.
        can_roll = scene[name].object_class.shape is not Shape.BOX
        assert dynamics[1] ** 2 == pytest.approx(SURFACE_FRICTION)
        assert dynamics[6] * dynamics[1] == pytest.approx(ROLLING_FRICTION if can_roll else 0)
        (visual,) = pybullet.getVisualShapeData(
            body, pybullet.VISUAL_SHAPE_DATA_TEXTURE_UNIQUE_IDS, physicsClientId=client
        )
        assert visual[8] >= 0, f"{name} has no texture"
        low, high = pybullet.getAABB(body, -1, physicsClientId=client)
        extents = scene[name].bounds_T
        assert np.all(np.array(low) < extents[0] + BULLET)
        assert np.all(np.array(high) > extents[1] - BULLET)
        assert np.all(
            np.subtract(high, low) < extents[1] - extents[0] + 0.08
        )  # Bullet's boxes around boxes are wide
    for _ in range(24):
        pybullet.setGravity(0, 0, -9.81, physicsClientId=client)
        pybullet.stepSimulation(physicsClientId=client)
    for body, name in list(zip(bodies, names, strict=True))[1:]:
        assert pybullet.getBasePositionAndOrientation(body, physicsClientId=client)[0][
            2
        ] == pytest.approx(scene[name].X_TO.p[2], abs=0.015)


def test_objects_have_their_size_in_pybullet(bullet: int, mug: ObjectClass, tmp_path: Path) -> None:
    """PyBullet inflates cylinders and meshes by 1 mm, for which the exported ones are smaller."""
    upright = Pose.from_rotation(np.eye(3), (-0.2, 0.2, mug.size[2] / 2))
    lying = Pose.from_rotation(
        Rotation.from_euler("x", np.pi / 2).as_matrix(), (0.2, 0.2, mug.size[1] / 2)
    )
    objects = [
        SceneObject("mug", mug, upright),
        SceneObject("lying mug", mug, lying),
        resting("large_marker", xy=(0.2, 0.0)),
        resting("tomato_soup_can", Orientation.UPRIGHT_0),
        resting("tomato_soup_can", Orientation.FLAT_0, (-0.2, 0.0), name="lying can"),
    ]
    path = export_scene(scene_of(*objects), ExportFormat.SDF, tmp_path)
    tray, *bodies = pybullet.loadSDF(str(path.with_name(PYBULLET_FILE)), physicsClientId=bullet)
    for body in bodies:
        contacts = pybullet.getClosestPoints(tray, body, 0.01, physicsClientId=bullet)
        # PyBullet's cylinders are prisms of 32 sides, up to 0.5 % of the radius smaller.
        assert min(contact[8] for contact in contacts) == pytest.approx(0.0, abs=2e-4)


def check_in_mujoco(scene: Scene, main_file: Path) -> None:
    model = mujoco.MjModel.from_xml_path(str(main_file))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert model.nbody == 2 + len(scene.objects)
    assert model.nq == 7 * len(scene.objects)
    assert model.ntex == 4
    for name in scene.names:
        body = model.body(name)
        X_TO = np.eye(4)
        X_TO[:3, :3], X_TO[:3, 3] = data.body(name).xmat.reshape(3, 3), data.body(name).xpos
        check(scene, name, float(body.mass[0]), X_TO)
        geoms = [
            model.geom(index) for index in range(body.geomadr[0], body.geomadr[0] + body.geomnum[0])
        ]
        visuals = [geom for geom in geoms if geom.group[0] == 2]
        contacts = [geom for geom in geoms if geom.group[0] == 3]
        assert [int(geom.contype[0]) for geom in visuals] == [0]
        assert model.mat_texid[visuals[0].matid[0]].max() >= 0
        assert len(contacts) == len(scene[name].object_class.convex_pieces)
        assert all(geom.friction[0] == SURFACE_FRICTION for geom in contacts)
        if scene[name].object_class.shape is not Shape.BOX:
            assert all(geom.condim[0] == 6 for geom in contacts)
            assert all(geom.friction[2] == ROLLING_FRICTION for geom in contacts)
    for name in scene.names:
        inertial = load_inertial(scene[name].object_class)
        xx, yy, zz, xy, xz, yz = inertial.inertia
        assert model.body(name).ipos == pytest.approx(inertial.com, abs=1e-9)
        R_OI = Rotation.from_quat(model.body(name).iquat, scalar_first=True).as_matrix()
        inertia = R_OI @ np.diag(model.body(name).inertia) @ R_OI.T
        assert inertia == pytest.approx(
            np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]), rel=1e-6, abs=1e-12
        )
    assert -0.02 < model.body("mug").ipos[0] < -0.005  # away from the handle
    before = data.xpos.copy()
    mujoco.mj_step(model, data, 200)
    assert np.abs(data.xpos - before)[:, 2].max() < 0.002


def check_in_trimesh(scene: Scene, main_file: Path) -> None:
    picture = trimesh.load_scene(main_file)
    assert set(picture.graph.nodes_geometry) == set(scene.names) | {
        f"tray/{part}" for part in ("floor", "rim_front", "rim_back", "rim_left", "rim_right")
    }
    y_up, _ = picture.graph.get("tray_frame")
    assert y_up @ [0, 0, 1, 0] == pytest.approx([0, 1, 0, 0])
    for name in scene.names:
        X_TO, geometry = picture.graph.get(name, "tray_frame")
        check(scene, name, None, X_TO)
        mesh = picture.geometry[geometry]
        assert isinstance(mesh.visual.material.baseColorTexture, Image.Image)
        assert mesh.extents == pytest.approx(scene[name].object_class.size, abs=1e-4)
    assert picture.bounds[1] - picture.bounds[0] == pytest.approx(
        np.array([0.666, 0.01 + scene["sugar_box"].top_height, 0.666]), abs=1e-4
    )


def check_in_usd(scene: Scene, main_file: Path) -> None:
    from pxr import Usd, UsdGeom, UsdPhysics

    stage = Usd.Stage.Open(str(main_file))
    objects = stage.GetPrimAtPath("/scene/objects").GetChildren()
    names = [prim.GetDisplayName() or prim.GetName() for prim in objects]
    assert names == list(scene.names)
    bounds = UsdGeom.BBoxCache(0, [UsdGeom.Tokens.guide])
    for prim, name in zip(objects, names, strict=True):
        X_TO = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(0)).T
        check(scene, name, UsdPhysics.MassAPI(prim).GetMassAttr().Get(), X_TO)
        colliders = [child for child in prim.GetChildren() if child.GetName() != "visual"]
        assert len(colliders) == len(scene[name].object_class.convex_pieces)
        boxes = [bounds.ComputeLocalBound(child).ComputeAlignedRange() for child in colliders]
        corners = scene[name].object_class.corners
        low = np.min([box.GetMin() for box in boxes], axis=0)
        high = np.max([box.GetMax() for box in boxes], axis=0)
        assert low == pytest.approx(corners.min(axis=0), abs=2e-4)
        assert high == pytest.approx(corners.max(axis=0), abs=2e-4)


def test_reads_back(exported: tuple[ExportFormat, Path], scene: Scene, bullet: int) -> None:
    format, main_file = exported
    if format is ExportFormat.DMD:
        check_in_drake(scene, main_file, main_file.parent / "package.xml")
    elif format is ExportFormat.SDF:
        check_in_drake(scene, main_file, None)
        check_in_pybullet(scene, main_file, bullet)
    elif format is ExportFormat.MJCF:
        check_in_mujoco(scene, main_file)
    elif format is ExportFormat.USD:
        check_in_usd(scene, main_file)
    else:
        check_in_trimesh(scene, main_file)


def test_refers_to_nothing_outside(exported: tuple[ExportFormat, Path], scene: Scene) -> None:
    _, main_file = exported
    folder = main_file.parent
    references = 0
    for file in (file for file in folder.rglob("*") if file.is_file()):
        assert not file.is_symlink()
        text = file.read_text(encoding="utf-8", errors="ignore")
        for groups in REFERENCE.findall(text):
            (reference,) = (group.strip() for group in groups if group)
            root = (
                folder if reference.startswith("package://") or file == main_file else file.parent
            )
            target = root / reference.removeprefix("package://drake_clutter_scene/")
            assert target.is_file(), f"{file}: {reference}"
            assert target.resolve().is_relative_to(folder.resolve()), f"{file}: {reference}"
            references += 1
        assert "file:" not in text.replace("    file: package:", "")
        for scene_object in scene.objects:
            assert str(scene_object.object_class.folder.parent) not in text
    # USD refers to a texture of each class.
    expected = {".glb": 0, ".usda": len({o.object_class for o in scene.objects})}
    assert references >= expected.get(main_file.suffix, len(scene.objects))


def test_textures_are_the_labels(exported: tuple[ExportFormat, Path], scene: Scene) -> None:
    format, main_file = exported
    if format in (ExportFormat.SDF, ExportFormat.MJCF, ExportFormat.USD):
        for object_class in {scene_object.object_class for scene_object in scene.objects}:
            with Image.open(main_file.parent / object_class.name / "label.png") as picture:
                label = load_visual(object_class).visual.material.baseColorTexture.convert("RGB")
                assert np.array_equal(np.asarray(picture), np.asarray(label))


@pytest.mark.parametrize("simulate", [simulate_mujoco, simulate_pybullet])
@pytest.mark.parametrize(("dataset_name", "index"), [("rg_25", 1), ("sg_star_25", 1), ("sg_14", 0)])
def test_stable_scenes_stay_at_rest(
    simulate: Callable[[Scene, float], float], dataset_name: str, index: int
) -> None:
    """The scenes have lying markers that roll away without rolling friction, and stacks on them."""
    dataset = load_scene_dataset(SCENES / f"{dataset_name}.json", CATALOG)
    scene = dataset.settled_scene(index, dataset.grammar, ClutterConfig())
    assert simulate(scene, 4.0) <= MAX_DISPLACEMENT


TABLE_TOP = -0.011
"""Height of the table in the default cell, and of that of simulations without a cell [m]."""


@pytest.fixture(scope="module")
def beside_tray(mug: ObjectClass) -> Scene:
    """Return a box, a can, a marker and a mug 2 mm above the table beside the tray."""
    cup = SceneObject("mug", mug, Pose((0.0, 0.5, mug.size[2] / 2)))
    objects = (
        resting("cracker_box", xy=(0.5, 0.5)),
        resting("tomato_soup_can", Orientation.UPRIGHT_0, (0.5, -0.5)),
        resting("large_marker", xy=(0.5, 0.0)),
        cup,
    )
    offset = (0.0, 0.0, TABLE_TOP + 0.002)
    return scene_of(*(replace(o, X_TO=o.X_TO.translated(offset)) for o in objects))


def drop_in_station(scene: Scene) -> dict[str, Pose]:
    """Return the poses in the simulation of the default cell after half a second."""
    classes = [(o.name, o.object_class) for o in scene.objects]
    station = ClutterStation(DEFAULT_CELL, classes, time_step=0.0025)
    simulator = Simulator(station)
    root = simulator.get_mutable_context()
    home = np.array(DEFAULT_CELL.robot.home)
    station.set_state(root, home, scene.objects)
    command = np.concatenate([home, np.zeros(2 * len(home))])
    station.GetInputPort("command").FixValue(root, command)
    station.GetInputPort("gripper_command").FixValue(root, np.zeros(0))
    simulator.AdvanceTo(0.5)
    return station.scene_plant.poses(station.plant_context(root))


def drop_on_tray(scene: Scene) -> dict[str, Pose]:
    """Return the poses in the simulation of the judge, which has no cell, at rest."""
    result = settle(scene.objects, scene.support, ClutterConfig().settle, simulate_collapse=True)
    assert result.instability is not None
    assert result.instability.reason is InstabilityReason.LEFT_TRAY
    return result.poses


@pytest.mark.parametrize("drop", [drop_in_station, drop_on_tray])
def test_what_leaves_the_tray_lies_on_the_table(
    drop: Callable[[Scene], dict[str, Pose]], beside_tray: Scene
) -> None:
    """Boxes sank through the table at 25 mm/s when their contact had a single point."""
    for name, X_TO in drop(beside_tray).items():
        expected = beside_tray[name].X_TO.translated((0.0, 0.0, -0.002))
        assert X_TO.p[2] == pytest.approx(expected.p[2], abs=0.0005), name
        assert X_TO.p == pytest.approx(expected.p, abs=0.002), name


@pytest.mark.parametrize("simulate", [simulate_mujoco, simulate_pybullet])
def test_exported_scenes_have_a_table(
    simulate: Callable[[Scene, float], float], beside_tray: Scene
) -> None:
    assert simulate(beside_tray, 1.0) == pytest.approx(0.002, abs=0.001)


@pytest.mark.parametrize(
    "name", ["tray", "world", "tray_frame", "__can__", "a/b", "../can", "a::b", "can ", "<can>"]
)
def test_refuses_names(name: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=re.escape(repr(name))):
        export_scene(scene_of(resting("sugar_box", name=name)), ExportFormat.MJCF, tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("format", ExportFormat)
def test_failure_leaves_an_empty_folder(format: ExportFormat, tmp_path: Path) -> None:
    sugar = resting("sugar_box")
    unbuilt = replace(sugar.object_class, name="unbuilt", folder=tmp_path / "unbuilt")
    out = tmp_path / "out"
    out.mkdir()
    with pytest.raises(InputError, match=r"unbuilt has no assets; run `drake-clutter assets build"):
        export_scene(scene_of(replace(sugar, object_class=unbuilt)), format, out)
    assert not list(out.iterdir())
    shutil.copytree(sugar.object_class.folder, unbuilt.folder)
    (unbuilt.folder / "visual.gltf").unlink()
    if format is not ExportFormat.DMD:  # which only copies
        with pytest.raises(Exception, match=r"visual\.gltf"):
            export_scene(
                scene_of(sugar, replace(sugar, name="second", object_class=unbuilt)), format, out
            )
        assert not list(out.iterdir())
