"""Built assets: Drake reads them; mass and inertia, contact properties, textures."""

import base64
import json
import math
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from conftest import DEFAULT_CELL
from PIL import Image
from pydrake.geometry import ProximityProperties, Role
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.systems.framework import DiagramBuilder
from scipy.spatial import ConvexHull

from drake_clutter.assets import MOTIFS, build_assets, build_class
from drake_clutter.assets.contact_properties import HYDROELASTIC_MODULUS, SURFACE_FRICTION
from drake_clutter.assets.textures import draw_texture
from drake_clutter.catalog import ObjectClass, RestOrientation, Shape, load_catalog
from drake_clutter.cell.support_sdf import support_sdf
from drake_clutter.files import InputError
from drake_clutter.resources import resource_path

CLASSES = load_catalog().classes
EXAMPLE = Path(__file__).parent.parent / "examples" / "custom_class"


def plant_of(model: str, package: Path) -> tuple[MultibodyPlant, list[ProximityProperties]]:
    """Return a plant of one model, parsed strictly, and all its collision geometries."""
    plant, scene_graph = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.002)
    parser = Parser(plant)
    parser.SetStrictParsing()
    parser.package_map().AddPackageXml(str(package))
    parser.AddModels(url=model)
    plant.Finalize()
    inspector = scene_graph.model_inspector()
    return plant, [
        inspector.GetProximityProperties(geometry)
        for geometry in inspector.GetAllGeometryIds(Role.kProximity)
    ]


def check_contact(properties: ProximityProperties, modulus: float | None) -> None:
    """Assert the contact properties; only a compliant geometry has a modulus."""
    assert properties.HasProperty("hydroelastic", "compliance_type")
    assert properties.HasProperty("hydroelastic", "hydroelastic_modulus") == (modulus is not None)
    if modulus is not None:
        assert properties.GetProperty("hydroelastic", "hydroelastic_modulus") == pytest.approx(
            modulus, rel=1e-3
        )
    friction = properties.GetProperty("material", "coulomb_friction")
    assert friction.static_friction() == friction.dynamic_friction() == SURFACE_FRICTION


def document(folder: Path) -> dict[str, Any]:
    """Return the glTF document of a visual."""
    read: dict[str, Any] = json.loads((folder / "visual.gltf").read_text())
    return read


def example(folder: Path) -> Path:
    """Return a copy of the example's sources."""
    folder.mkdir()
    for name in ("catalog.yaml", "mug.stl"):
        shutil.copy(EXAMPLE / name, folder)
    return folder


def user_class(folder: Path, text: str) -> Path:
    (folder / "catalog.yaml").write_text(f"classes:\n  block: {text}\n")
    return folder


@pytest.mark.parametrize("entry", CLASSES.values(), ids=list(CLASSES))
def test_shipped_model(entry: ObjectClass) -> None:
    plant, contacts = plant_of(
        f"package://drake_clutter_objects/{entry.name}/model.sdf",
        resource_path("sdf_assets/package.xml"),
    )
    body = plant.GetBodyByName("body")
    assert body.default_mass() == pytest.approx(entry.mass, rel=1e-9)
    inertia = body.default_spatial_inertia()
    assert inertia.get_com() == pytest.approx(np.zeros(3), abs=1e-12)
    x, y, z = entry.size
    if entry.shape is Shape.BOX:
        moments = np.array([y**2 + z**2, x**2 + z**2, x**2 + y**2]) / 12
    else:
        moments = np.array([x**2 / 16 + z**2 / 12, x**2 / 16 + z**2 / 12, x**2 / 8])
    assert inertia.CalcRotationalInertia().CopyToFullMatrix3() == pytest.approx(
        entry.mass * np.diag(moments), rel=1e-9, abs=1e-18
    )
    (contact,) = contacts
    check_contact(contact, HYDROELASTIC_MODULUS)
    if entry.shape is Shape.CYLINDER:
        # Drake puts ceil(circumference / hint) edges around, at any size.
        edges = math.ceil(math.pi * x / contact.GetProperty("hydroelastic", "resolution_hint"))
        assert edges == (16 if entry.only_rest is RestOrientation.UPRIGHT else 32)


@pytest.mark.parametrize("entry", CLASSES.values(), ids=list(CLASSES))
def test_shipped_visual(entry: ObjectClass) -> None:
    gltf = document(entry.folder)
    assert [item["uri"][:5] for item in gltf["images"] + gltf["buffers"]] == ["data:", "data:"]
    (primitive,) = gltf["meshes"][0]["primitives"]
    bounds = gltf["accessors"][primitive["attributes"]["POSITION"]]
    x, y, z = entry.size
    assert np.subtract(bounds["max"], bounds["min"]) == pytest.approx([x, z, y], rel=1e-6)  # y up
    assert sum(file.stat().st_size for file in entry.folder.iterdir()) < 150_000


@pytest.mark.parametrize("name", ["cracker_box", "tomato_soup_can"])
def test_triangles_face_outwards(name: str) -> None:
    gltf = document(CLASSES[name].folder)
    buffer = base64.b64decode(gltf["buffers"][0]["uri"].partition(",")[2])
    arrays = []
    for view, width, kind in zip(
        gltf["bufferViews"], (3, 3, 2, 3), ("<f4", "<f4", "<f4", "<u4"), strict=True
    ):
        start = view["byteOffset"]
        arrays.append(
            np.frombuffer(buffer[start : start + view["byteLength"]], kind).reshape(-1, width)
        )
    points, normals, uv, triangles = arrays
    a, b, c = (points[triangles[:, i]].astype(float) for i in range(3))
    across = np.cross(b - a, c - a)
    assert np.all(np.sum(across * normals[triangles[:, 0]], axis=1) > 0)
    assert np.all(np.sum(across * (a + b + c), axis=1) > 0)
    assert uv.min() >= 0
    assert uv.max() <= 1


def test_the_committed_assets_are_what_the_code_builds(tmp_path: Path) -> None:
    for name in ("gelatin_box", "large_marker"):
        built = build_class(CLASSES[name], tmp_path)
        committed = CLASSES[name].folder
        assert sorted(file.name for file in built.iterdir()) == sorted(
            file.name for file in committed.iterdir()
        )
        for file in built.iterdir():
            assert file.read_bytes() == (committed / file.name).read_bytes(), (
                f"{name}/{file.name}: build the assets again"
            )


def test_labels_differ() -> None:
    """The expected faces are on top of a lying package, by their mean colors (sRGB)."""
    means = {}
    for name, entry in CLASSES.items():
        texture = draw_texture(entry)
        u0, v0, u1, v1 = texture.regions["front" if entry.shape is Shape.BOX else "side"]
        width, height = texture.image.size
        front = texture.image.crop(
            (round(u0 * width), round(v0 * height), round(u1 * width), round(v1 * height))
        )
        means[name] = np.asarray(front, float).mean(axis=(0, 1))
    distances = {(a, b): np.linalg.norm(means[a] - means[b]) for a in means for b in means if a < b}
    assert min(distances.values()) > 20, min(distances, key=lambda pair: distances[pair])


def test_every_motif_draws(tmp_path: Path) -> None:
    pictures = set()
    for motif in MOTIFS:
        folder = tmp_path / motif
        folder.mkdir()
        user_class(
            folder, f"{{shape: box, size_mm: [20, 30, 40], mass_g: 50, label: {{motif: {motif}}}}}"
        )
        image = draw_texture(load_catalog(folder).classes["block"]).image
        assert isinstance(image, Image.Image)
        pictures.add(image.tobytes())
    assert len(pictures) == len(MOTIFS)


@pytest.fixture(scope="module")
def built_example(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = example(tmp_path_factory.mktemp("user") / "custom_class")
    assert build_assets(folder) == [folder / "mug"]
    return folder


def test_convex_pieces_cover_the_example(built_example: Path) -> None:
    mug = load_catalog(built_example).classes["mug"]
    assert 5 <= len(mug.convex_pieces) <= 40
    assert np.ptp(mug.corners, axis=0) == pytest.approx(mug.size, rel=1e-3)
    hulls = [trimesh.convex.convex_hull(piece) for piece in mug.convex_pieces]
    solid = trimesh.load_mesh(EXAMPLE / "mug.stl").volume
    assert solid <= sum(hull.volume for hull in hulls) < 1.3 * solid
    on_axis = np.array([-0.0175, 0.0, 0.0])  # where the coffee is
    assert all(
        np.any(
            hull.face_normals @ on_axis > np.sum(hull.face_normals * hull.triangles[:, 0], axis=1)
        )
        for hull in hulls
    )


def test_example_loads_in_drake(built_example: Path) -> None:
    plant, contacts = plant_of(
        "package://custom_class/mug/model.sdf", built_example / "package.xml"
    )
    inertia = plant.GetBodyByName("body").default_spatial_inertia()
    assert inertia.get_mass() == pytest.approx(0.330, rel=1e-9)
    assert inertia.IsPhysicallyValid()
    assert -0.02 < inertia.get_com()[0] < -0.005  # away from the handle
    assert inertia.get_com()[2] < 0  # towards the base
    mug = load_catalog(built_example).classes["mug"]
    assert len(contacts) == len(mug.convex_pieces)
    _, middle, largest = sorted(mug.size)
    for contact, corners in zip(contacts, mug.convex_pieces, strict=True):
        center = trimesh.convex.convex_hull(corners).center_mass
        faces = ConvexHull(corners).equations
        depth = -(faces[:, :3] @ center + faces[:, 3]).max()
        check_contact(contact, 5e8 * 0.330 * depth / (middle * largest))


def test_a_sheet_is_as_stiff_on_its_face_as_a_box(tmp_path: Path) -> None:
    """Its squared frequency, modulus * area / (depth * mass), is 5e8 rad^2/s^2."""
    user_class(tmp_path, "{shape: box, size_mm: [4, 150, 200], mass_g: 250}")
    build_assets(tmp_path)
    _, (contact,) = plant_of(f"package://{tmp_path.name}/block/model.sdf", tmp_path / "package.xml")
    check_contact(contact, 5e8 * 0.250 * 0.002 / (0.15 * 0.20))


def test_convex_mesh_is_one_piece_with_the_inertia_of_its_box(tmp_path: Path) -> None:
    user_class(tmp_path, "{shape: mesh, mesh: block.stl, mass_g: 120}")
    block = trimesh.creation.box((0.05, 0.06, 0.07))
    block.apply_translation((1, 2, 3))  # the frame moves to its center
    block.export(tmp_path / "block.stl")
    build_assets(tmp_path)
    (corners,) = load_catalog(tmp_path).classes["block"].convex_pieces
    assert corners.max(axis=0) == pytest.approx([0.025, 0.03, 0.035], abs=1e-6)
    plant, _ = plant_of(f"package://{tmp_path.name}/block/model.sdf", tmp_path / "package.xml")
    inertia = plant.GetBodyByName("body").default_spatial_inertia()
    expected = 0.120 / 12 * np.diag([0.06**2 + 0.07**2, 0.05**2 + 0.07**2, 0.05**2 + 0.06**2])
    assert inertia.get_com() == pytest.approx(np.zeros(3), abs=1e-6)
    assert inertia.CalcRotationalInertia().CopyToFullMatrix3() == pytest.approx(
        expected, rel=1e-4, abs=1e-9
    )


@pytest.mark.parametrize(
    ("label", "complaint"),
    [
        (
            "{motif: unicorns}",
            r"classes\.block\.label\.motif: 'unicorns'; expected dots, crackers",
        ),
        ("{base: red}", r"classes\.block\.label\.base: 'red'; expected a color"),
        ("{accent: '#12345'}", r"classes\.block\.label\.accent"),
        (
            "{title: A title too long for the label}",
            r"classes\.block\.label\.title: .*at most 24",
        ),
    ],
)
def test_bad_label(tmp_path: Path, label: str, complaint: str) -> None:
    user_class(tmp_path, f"{{shape: box, size_mm: [20, 30, 40], mass_g: 50, label: {label}}}")
    with pytest.raises(InputError, match=complaint) as caught:
        build_assets(tmp_path)
    assert str(tmp_path / "catalog.yaml") in str(caught.value)
    assert [entry.name for entry in tmp_path.iterdir()] == ["catalog.yaml"]


def test_builds_only_the_named_classes(tmp_path: Path) -> None:
    box = "{shape: box, size_mm: [20, 30, 40], mass_g: 50, source: 'ends in -->'}"
    (tmp_path / "catalog.yaml").write_text(f"classes:\n  one: {box}\n  two: {box}\n")
    assert build_assets(tmp_path, ["two"]) == [tmp_path / "two"]
    assert not (tmp_path / "one").exists()
    plant_of(f"package://{tmp_path.name}/two/model.sdf", tmp_path / "package.xml")
    with pytest.raises(InputError, match="no sugar_box; expected one, two"):
        build_assets(tmp_path, ["sugar_box"])


def test_keeps_files_that_it_did_not_build(tmp_path: Path) -> None:
    user_class(tmp_path, "{shape: box, size_mm: [20, 30, 40], mass_g: 50}")
    (tmp_path / "block").mkdir()
    (tmp_path / "block" / "scan.stl").write_text("mine")
    with pytest.raises(InputError, match=r"block: holds scan\.stl"):
        build_assets(tmp_path)
    assert (tmp_path / "block" / "scan.stl").read_text() == "mine"


def test_the_tray(tmp_path: Path) -> None:
    (tmp_path / "tray.sdf").write_text(support_sdf(DEFAULT_CELL.support, table=False))
    (tmp_path / "package.xml").write_text("<package><name>it</name></package>")
    plant, contacts = plant_of("package://it/tray.sdf", tmp_path / "package.xml")
    assert len(contacts) == 5
    for contact in contacts:
        check_contact(contact, None)
    assert plant.num_bodies() == 2


def test_the_builder_leaves_drake_s_reader_alone() -> None:
    """CoACD is loaded in a process of its own; otherwise Drake's SDF reader would throw."""
    code = (
        "import drake_clutter.assets, drake_clutter.simulation.scene_plant as p; "
        "from pydrake.systems.framework import DiagramBuilder;"
        "from drake_clutter.cell.work_cell import default_cell;"
        "p.add_scene_plant(DiagramBuilder(), [], default_cell().support, 0.01, visuals=False)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
