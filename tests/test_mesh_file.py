"""Meshes of a user: what is accepted, what is repaired, and what is refused with which message."""

# trimesh is typed in part only.
# mypy: allow-untyped-calls

from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from drake_clutter.files import InputError
from drake_clutter.mesh_file import ObjectMesh, load_object_mesh, measure_windings

SIZE = (0.05, 0.06, 0.07)
VOLUME = 0.05 * 0.06 * 0.07


def write_cube_with_seams(folder: Path) -> Path:
    """Write a box as an OBJ file whose faces have vertices, normals and a texture of their own."""
    box = trimesh.creation.box(SIZE)
    lines = ["mtllib cube.mtl", "o cube", "usemtl label"]
    uv = [(0, 0), (1, 0), (1, 1), (0, 1)]
    lines += [f"vt {u} {v}" for u, v in uv]
    for index, (face, normal) in enumerate(zip(box.faces, box.face_normals, strict=True)):
        lines += ["v {} {} {}".format(*box.vertices[vertex]) for vertex in face]
        lines.append("vn {} {} {}".format(*normal))
        corners = [f"{3 * index + k + 1}/{k + 1}/{index + 1}" for k in range(3)]
        lines.append(f"f {' '.join(corners)}")
    (folder / "cube.obj").write_text("\n".join(lines) + "\n")
    (folder / "cube.mtl").write_text("newmtl label\nKd 1 1 1\nmap_Kd label.png\n")
    Image.new("RGB", (8, 8), (200, 30, 40)).save(folder / "label.png")
    return folder / "cube.obj"


def write_two_materials(folder: Path) -> Path:
    """Write a box whose upper and lower triangles have different materials."""
    box = trimesh.creation.box(SIZE)
    lines = ["mtllib two.mtl"] + ["v {} {} {}".format(*vertex) for vertex in box.vertices]
    for name, faces in (("red", box.faces[:6]), ("blue", box.faces[6:])):
        lines.append(f"usemtl {name}")
        lines += ["f {} {} {}".format(*(face + 1)) for face in faces]
    (folder / "two.obj").write_text("\n".join(lines) + "\n")
    (folder / "two.mtl").write_text("newmtl red\nKd 1 0 0\nnewmtl blue\nKd 0 0 1\n")
    return folder / "two.obj"


def load(mesh: trimesh.Trimesh, folder: Path, name: str = "mesh.stl") -> ObjectMesh:
    """Write a mesh and return it as it is read."""
    mesh.export(folder / name)
    return load_object_mesh(folder / name, "mesh")


def joined(meshes: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    """Return several meshes as one."""
    mesh = trimesh.util.concatenate(meshes)
    assert isinstance(mesh, trimesh.Trimesh)
    return mesh


def check_box(mesh: ObjectMesh) -> None:
    """Assert that a mesh is the closed box with outward normals."""
    assert mesh.solid.is_watertight
    assert mesh.solid.is_winding_consistent
    assert mesh.solid.volume == pytest.approx(VOLUME, rel=1e-5)
    assert mesh.solid.extents == pytest.approx(SIZE, abs=1e-7)
    assert len(mesh.solid.vertices) == 8
    assert sum(len(part.triangles) for part in mesh.parts) == 12
    for part in mesh.parts:  # what is seen is turned outward, too
        a, b, c = (part.points[part.triangles[:, k]] for k in range(3))
        assert np.all((np.cross(b - a, c - a) * (a + b + c)).sum(axis=1) > 0)


@pytest.mark.parametrize("write", [write_cube_with_seams, write_two_materials])
def test_split_vertices_are_merged(tmp_path: Path, write: object) -> None:
    assert callable(write)
    mesh = load_object_mesh(write(tmp_path), "mesh")
    check_box(mesh)
    assert mesh.repairs == ()
    assert mesh.holes == ()


@pytest.mark.parametrize("name", ["box.stl", "box.obj", "box.ply", "box.off"])
def test_formats_with_z_up(tmp_path: Path, name: str) -> None:
    check_box(load(trimesh.creation.box(SIZE), tmp_path, name))


def test_vertices_per_face_are_merged_in_ply(tmp_path: Path) -> None:
    box = trimesh.creation.box(SIZE)
    split = trimesh.Trimesh(
        box.triangles.reshape(-1, 3), np.arange(36).reshape(-1, 3), process=False
    )
    check_box(load(split, tmp_path, "split.ply"))


@pytest.mark.parametrize("name", ["bottle.glb", "bottle.gltf"])
def test_gltf_is_y_up(tmp_path: Path, name: str) -> None:
    """A bottle that stands in the y direction of glTF stands upright, its neck on top."""
    bottle = trimesh.creation.revolve(
        np.array([[0, 0], [0.03, 0], [0.03, 0.12], [0.012, 0.15], [0.012, 0.2], [0, 0.2]]),
        sections=24,
    )
    bottle.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0]))
    assert bottle.extents[1] == pytest.approx(0.2)
    bottle.export(tmp_path / name)
    solid = load_object_mesh(tmp_path / name, "mesh").solid
    assert solid.extents[2] == pytest.approx(0.2, abs=1e-6)
    assert solid.center_mass[2] < -0.01  # the belly is below
    assert solid.volume == pytest.approx(bottle.volume, rel=1e-4)


def test_an_inverted_mesh_is_turned_outward(tmp_path: Path) -> None:
    box = trimesh.creation.box(SIZE)
    box.invert()
    mesh = load(box, tmp_path)
    check_box(mesh)
    assert mesh.repairs == ("turned its inward normals outward",)


def test_mixed_winding_is_repaired(tmp_path: Path) -> None:
    box = trimesh.creation.box(SIZE)
    faces = box.faces.copy()
    faces[[2, 7]] = faces[[2, 7], ::-1]
    mesh = load(trimesh.Trimesh(box.vertices, faces, process=False), tmp_path)
    check_box(mesh)
    assert "winding" in mesh.repairs[0]


def test_an_inverted_body_beside_another_is_turned_outward(tmp_path: Path) -> None:
    """Both bodies count positively: the inertia is that of two boxes."""
    inverted = trimesh.creation.box(SIZE)
    inverted.invert()
    inverted.apply_translation([0.1, 0, 0])
    both = joined([trimesh.creation.box(SIZE), inverted])
    mesh = load(both, tmp_path)
    assert mesh.solid.volume == pytest.approx(2 * VOLUME, rel=1e-5)
    assert len(mesh.repairs) == 1
    assert "body 2 of 2" in mesh.repairs[0]
    moments = np.linalg.eigvalsh(mesh.solid.moment_inertia)
    assert moments[2] <= moments[0] + moments[1]


def test_a_cavity_stays_a_cavity(tmp_path: Path) -> None:
    inner = trimesh.creation.box(np.array(SIZE) / 2)
    inner.invert()
    mesh = load(joined([trimesh.creation.box(SIZE), inner]), tmp_path)
    assert mesh.solid.volume == pytest.approx(VOLUME * 7 / 8, rel=1e-5)
    assert mesh.repairs == ()
    inverted, overlap = measure_windings(mesh.solid)
    assert inverted.fraction == overlap.fraction == 0


def test_winding_numbers_find_overlap_and_inversion() -> None:
    """Boxes that share half their length overlap in a third of their union."""
    box = trimesh.creation.box(SIZE)
    moved = box.copy()
    moved.apply_translation([0.025, 0, 0])
    overlap = measure_windings(joined([box, moved]))[1]
    assert overlap.fraction == pytest.approx(1 / 3, abs=0.02)
    assert 0 < overlap.place[0] < 0.025
    moved.apply_translation([0.1, 0, 0])
    moved.invert()
    inverted = measure_windings(joined([box, moved]))[0]
    assert inverted.fraction == pytest.approx(0.5, abs=0.02)
    assert inverted.place == pytest.approx([0.125, 0, 0], abs=0.04)


def test_degenerate_and_repeated_triangles_are_removed(tmp_path: Path) -> None:
    box = trimesh.creation.box(SIZE)
    faces = np.vstack([box.faces, [[0, 0, 1], [3, 3, 3]], box.faces[4:5, [1, 2, 0]]])
    check_box(load(trimesh.Trimesh(box.vertices, faces, process=False), tmp_path, "mesh.obj"))


def test_a_small_hole_is_closed_and_listed(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.04)
    opened = trimesh.Trimesh(ball.vertices, ball.faces[1:], process=False)
    mesh = load(opened, tmp_path)
    assert mesh.solid.is_watertight
    assert mesh.solid.volume == pytest.approx(ball.volume, rel=1e-4)
    assert len(mesh.holes) == 1
    assert "hole of 3 edges" in mesh.holes[0]


def refuse(mesh: trimesh.Trimesh, folder: Path, complaint: str, name: str = "mesh.stl") -> None:
    with pytest.raises(InputError, match=complaint) as caught:
        load(mesh, folder, name)
    assert name in str(caught.value)


def test_an_open_box_is_refused_with_the_place_of_its_hole(tmp_path: Path) -> None:
    box = trimesh.creation.box(SIZE)
    top = box.face_normals[:, 2] > 0.5
    opened = trimesh.Trimesh(box.vertices, box.faces[~top], process=False)
    refuse(
        opened,
        tmp_path,
        r"not watertight: 4 open edges around a hole 60 mm wide at \(-?0\.025, -?0\.03, 0\.035\)",
    )


def test_the_message_names_the_open_body(tmp_path: Path) -> None:
    box = trimesh.creation.box(SIZE)
    cap = trimesh.creation.cylinder(0.01, 0.02)
    cap = trimesh.Trimesh(cap.vertices, cap.faces[:-30], process=False)
    cap.apply_translation([0, 0, 0.06])
    scene = trimesh.Scene()
    scene.add_geometry(box, node_name="crate", geom_name="crate")
    scene.add_geometry(cap, node_name="cap", geom_name="cap")
    scene.export(tmp_path / "two.glb")
    with pytest.raises(InputError, match=r"body \d of 2 \(cap\): is not watertight"):
        load_object_mesh(tmp_path / "two.glb", "mesh")


def test_flat_pieces_are_refused(tmp_path: Path) -> None:
    sheet = trimesh.Trimesh(
        [[0, 0, 0.1], [0.05, 0, 0.1], [0.05, 0.05, 0.1], [0, 0.05, 0.1]], [[0, 1, 2], [0, 2, 3]]
    )
    refuse(sheet, tmp_path, "flat surface without volume")
    doubled = joined([sheet, sheet])
    doubled.faces[2:] = doubled.faces[2:, ::-1]
    both = joined([trimesh.creation.box(SIZE), sheet])
    refuse(both, tmp_path, r"body 2 of 2 .*: is a flat surface without thickness, at \(.*0\.1\)")
    both = joined([trimesh.creation.box(SIZE), doubled])
    refuse(both, tmp_path, "is a flat surface without thickness")


def test_a_doubled_curved_sheet_is_refused(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.04)
    upper = ball.faces[ball.triangles_center[:, 2] > 0]
    sheet = trimesh.Trimesh(ball.vertices, np.vstack([upper, upper[:, ::-1]]), process=False)
    refuse(sheet, tmp_path, "more than two triangles meet at an edge at")


def test_vertices_that_are_not_finite_are_refused(tmp_path: Path) -> None:
    text = "v 0 0 0\nv 0.1 0 0\nv 0 nan 0\nv 0 0 0.1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
    (tmp_path / "nan.obj").write_text(text)
    with pytest.raises(InputError, match=r"1 vertices are not finite; the first is \(0, nan, 0\)"):
        load_object_mesh(tmp_path / "nan.obj", "mesh")


@pytest.mark.parametrize(
    ("scale", "hint"),
    [(1000, r"in mm\? Set `mesh_unit: mm`"), (100, r"in cm\? Set `mesh_unit: cm`")],
)
def test_other_units_are_refused_with_a_hint(tmp_path: Path, scale: float, hint: str) -> None:
    refuse(trimesh.creation.box(np.array([0.1, 0.1, 0.2]) * scale), tmp_path, hint)


def test_a_one_sided_surface_is_refused(tmp_path: Path) -> None:
    """A Klein bottle is closed but has no inside."""
    n = 24
    grid = np.arange(n * n).reshape(n, n)
    u, v = np.meshgrid(*((np.arange(n) + 0.5) * 2 * np.pi / n,) * 2, indexing="ij")
    radius = 0.06 + 0.02 * (np.cos(u / 2) * np.sin(v) - np.sin(u / 2) * np.sin(2 * v))
    z = 0.02 * (np.sin(u / 2) * np.sin(v) + np.cos(u / 2) * np.sin(2 * v))
    points = np.stack([radius * np.cos(u), radius * np.sin(u), z], axis=-1).reshape(-1, 3)
    below = np.roll(grid, -1, axis=0)
    below[-1] = grid[0, ::-1]  # the tube closes upside down
    a, b, c, d = (x.reshape(-1) for x in (grid, below, np.roll(below, -1, 1), np.roll(grid, -1, 1)))
    faces = np.vstack([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    refuse(trimesh.Trimesh(points, faces, process=False), tmp_path, "has no inside", "klein.obj")
