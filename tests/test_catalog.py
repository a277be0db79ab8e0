"""The shipped catalog, and errors for invalid ones."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from conftest import TRAY
from pydrake.systems.framework import DiagramBuilder

from drake_clutter.assets import build_assets
from drake_clutter.catalog import ObjectClass, PairArrangement, RestOrientation, Shape, load_catalog
from drake_clutter.cell.sdf_text import read_sdf_text
from drake_clutter.files import InputError
from drake_clutter.simulation.scene_plant import add_scene_plant

BOX = "shape: box, size_mm: [10, 20, 30], mass_g: 50"


def user_catalog(folder: Path, text: str) -> Path:
    """Return a folder with `text` as its catalog."""
    (folder / "catalog.yaml").write_text(text)
    return folder


def test_shipped_sets() -> None:
    catalog = load_catalog()
    ycb7, pantry14 = catalog.object_set("ycb7"), catalog.object_set("pantry14")
    assert pantry14[:7] == ycb7
    assert {entry.name for entry in pantry14} == set(catalog.classes)
    # 3 structural rules, one insertion for each class and pair, 10 orientations: 30 and 49, as in
    # the paper.
    assert [
        13 + sum(1 + len(entry.pairs) for entry in entries) for entries in (ycb7, pantry14)
    ] == [30, 49]


@pytest.mark.parametrize(
    ("name", "shape", "size", "mass"),
    [
        ("cracker_box", Shape.BOX, (0.060, 0.160, 0.230), 0.411),
        ("sugar_box", Shape.BOX, (0.038, 0.089, 0.175), 0.514),
        ("pudding_box", Shape.BOX, (0.035, 0.110, 0.089), 0.187),
        ("gelatin_box", Shape.BOX, (0.028, 0.085, 0.073), 0.097),
        ("master_chef_can", Shape.CYLINDER, (0.102, 0.102, 0.139), 0.414),
        ("tomato_soup_can", Shape.CYLINDER, (0.066, 0.066, 0.101), 0.349),
        ("large_marker", Shape.CYLINDER, (0.018, 0.018, 0.121), 0.0158),
        ("pringles_can", Shape.CYLINDER, (0.075, 0.075, 0.250), 0.205),
    ],
)
def test_ycb_measures(
    name: str, shape: Shape, size: tuple[float, float, float], mass: float
) -> None:
    entry = load_catalog().classes[name]
    assert entry.shape is shape
    assert entry.size == pytest.approx(size)
    assert entry.mass == pytest.approx(mass)
    assert "YCB" in entry.source


def test_cans_stand_and_pairs_follow_the_grammar() -> None:
    classes = load_catalog().classes
    assert {
        name for name, entry in classes.items() if entry.only_rest is RestOrientation.UPRIGHT
    } == {
        "master_chef_can",
        "tomato_soup_can",
        "pringles_can",
    }
    assert classes["cracker_box"].pairs == (PairArrangement.LYING, PairArrangement.STANDING)
    assert classes["large_marker"].pairs == (PairArrangement.LYING,)
    assert classes["tomato_soup_can"].pairs == (PairArrangement.STANDING,)


@pytest.mark.parametrize("name", list(load_catalog().classes))
def test_corners_span_the_size(name: str) -> None:
    entry = load_catalog().classes[name]
    assert np.ptp(entry.corners, axis=0) == pytest.approx(entry.size)
    assert entry.corners.min(axis=0) == pytest.approx(-entry.corners.max(axis=0))


def test_user_sets_mix_with_shipped(tmp_path: Path) -> None:
    user_catalog(
        tmp_path, f"classes:\n  brick: {{{BOX}}}\nobject_sets:\n  mixed: [sugar_box, brick]\n"
    )
    catalog = load_catalog(tmp_path)
    assert [entry.name for entry in catalog.object_set("mixed")] == ["sugar_box", "brick"]
    assert catalog.classes["brick"].folder == tmp_path.resolve() / "brick"
    assert catalog.folders[1] == tmp_path.resolve()


@pytest.mark.parametrize(
    ("entry", "complaint"),
    [
        (
            "brick: {shape: pyramid, size_mm: [10, 10, 10], mass_g: 5}",
            r"classes\.brick\.shape: 'pyramid'; expected one of box, cylinder, mesh",
        ),
        (
            "brick: {shape: box, size_mm: [10, 20], mass_g: 5}",
            r"size_mm: \[10, 20\]; expected a list of 3 numbers",
        ),
        (
            "brick: {shape: box, size_mm: [10, -20, 30], mass_g: 5}",
            r"size_mm\[1\]: -20; expected .* from 3 to 1000",
        ),
        ("brick: {shape: box, size_mm: [10, .nan, 30], mass_g: 5}", r"classes\.brick\.size_mm"),
        (
            "brick: {shape: cylinder, size_mm: [10, 20, 30], mass_g: 5}",
            r"size_mm: .*\[10, 20, 30\]; expected diameter, ",
        ),
        (
            "brick: {shape: box, size_mm: [10, 20, 30]}",
            r"classes\.brick\.mass_g: is missing; needed are shape, mass_g",
        ),
        ("brick: {shape: box, size_mm: [10, 20, 30], mass_g: 0}", r"classes\.brick\.mass_g: 0"),
        (
            f"brick: {{{BOX}, pairs: [leaning]}}",
            r"classes\.brick\.pairs\[0\]: 'leaning'; expected one of lying, standing",
        ),
        (f"brick: {{{BOX}, pairs: [lying, lying]}}", r"classes\.brick\.pairs: .*once"),
        (
            f"brick: {{{BOX}, color: red}}",
            r"classes\.brick\.color: is unknown; expected shape, size_mm",
        ),
        (f"Brick: {{{BOX}}}", r"classes\.Brick: 'Brick'; expected a name of lower-case letters"),
        (f"tray: {{{BOX}}}", r"classes\.tray: 'tray'; expected a name of .* none of .*tray"),
        (f"sugar_box: {{{BOX}}}", r"classes\.sugar_box: is shipped already"),
        (
            "brick: {shape: mesh, mass_g: 5}",
            r"classes\.brick: .* expected `mesh` and no `size_mm` for a mesh",
        ),
        (
            f"brick: {{{BOX}, mesh: brick.stl}}",
            r"classes\.brick: .* expected `mesh` and no `size_mm` for a mesh",
        ),
        ("brick: {shape: mesh, mesh: brick.stl, mass_g: 5}", r"classes\.brick\.mesh: no file"),
    ],
)
def test_bad_class(tmp_path: Path, entry: str, complaint: str) -> None:
    user_catalog(tmp_path, f"classes:\n  {entry}\n")
    with pytest.raises(InputError, match=complaint) as caught:
        load_catalog(tmp_path)
    assert str(tmp_path / "catalog.yaml") in str(caught.value)


@pytest.mark.parametrize("members", ["[sugar_box, teapot]", "[sugar_box, sugar_box]", "[]"])
def test_bad_object_set(tmp_path: Path, members: str) -> None:
    user_catalog(tmp_path, f"object_sets:\n  tea: {members}\n")
    with pytest.raises(
        InputError, match=r"object_sets\.tea: .*expected a list, without repeats, of cracker_box"
    ):
        load_catalog(tmp_path)


def test_unknown_object_set() -> None:
    with pytest.raises(InputError, match=r"'ycb8' is unknown; known are ycb7, pantry14"):
        load_catalog().object_set("ycb8")


def test_a_catalog_under_its_earlier_file_name(tmp_path: Path) -> None:
    block = "{shape: box, size_mm: [50, 40, 30], mass_g: 100, label: {base: blue}}"
    (tmp_path / "catalogue.yaml").write_text(f"classes:\n  block: {block}\n")
    assert "block" in load_catalog(tmp_path).classes
    with pytest.raises(InputError, match=r"catalogue\.yaml: classes\.block\.label\.base"):
        build_assets(tmp_path)


def test_no_catalog(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no such file; an asset folder contains catalog\.yaml"):
        load_catalog(tmp_path)


def test_catalog_that_is_not_yaml(tmp_path: Path) -> None:
    user_catalog(tmp_path, "classes: [unclosed")
    with pytest.raises(InputError, match=r"catalog\.yaml"):
        load_catalog(tmp_path)


def test_bad_meshes(tmp_path: Path) -> None:
    user_catalog(tmp_path, "classes:\n  block: {shape: mesh, mesh: block.stl, mass_g: 5}\n")
    block = trimesh.creation.box((0.05, 0.05, 0.05))
    opened = trimesh.Trimesh(block.vertices, block.faces[:-1])
    in_millimetres = trimesh.creation.box((50, 50, 50))
    for mesh, complaint in (
        (opened, "not watertight"),
        (in_millimetres, r"expected 0\.003 to 1 m"),
    ):
        mesh.export(tmp_path / "block.stl")
        with pytest.raises(InputError, match=complaint):
            load_catalog(tmp_path)
    (tmp_path / "block.stl").write_text("no mesh")
    with pytest.raises(InputError, match=r"classes\.block\.mesh"):
        load_catalog(tmp_path)


def test_mesh_without_assets(tmp_path: Path) -> None:
    user_catalog(tmp_path, "classes:\n  block: {shape: mesh, mesh: block.stl, mass_g: 5}\n")
    trimesh.creation.box((0.05, 0.06, 0.07)).export(tmp_path / "block.stl")
    block = load_catalog(tmp_path).classes["block"]
    assert block.size == pytest.approx((0.05, 0.06, 0.07))
    with pytest.raises(InputError, match="run `drake-clutter assets build"):
        _ = block.convex_pieces


def test_a_model_of_another_mass_is_refused(tmp_path: Path) -> None:
    """A changed mass is refused until the model is built again; then it is simulated."""

    def block(mass_g: int) -> ObjectClass:
        block = f"{{shape: box, size_mm: [50, 60, 70], mass_g: {mass_g}, source: made up}}"
        text = f"classes:\n  block: {block}\n"
        load_catalog.cache_clear()  # a process reads a folder once
        read_sdf_text.cache_clear()
        return load_catalog(user_catalog(tmp_path, text)).classes["block"]

    def body_mass(entry: ObjectClass) -> float:
        made = add_scene_plant(DiagramBuilder(), [("it", entry)], TRAY, 0.01, visuals=False)
        return float(made.bodies["it"].default_mass())

    with pytest.raises(
        InputError, match="class block has no assets; run `drake-clutter assets build"
    ):
        body_mass(block(100))
    build_assets(tmp_path)
    assert body_mass(block(100)) == pytest.approx(0.100)
    with pytest.raises(
        InputError, match=r"model\.sdf: mass: 0\.1; expected the catalog's, 0\.15 kg; run"
    ):
        body_mass(block(150))
    build_assets(tmp_path)
    assert body_mass(block(150)) == pytest.approx(0.150)
