"""Assets of users' meshes: what is written is what was in the file, and what is refused."""

# trimesh is typed in part only.
# mypy: allow-untyped-calls

import base64
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from conftest import rng, scene_of
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial import ConvexHull
from test_mesh_file import SIZE, write_cube_with_seams, write_two_materials
from typer.testing import CliRunner

from drake_clutter.assets import build_assets, convex_pieces
from drake_clutter.assets.convex_pieces import (
    MAX_PIECE_CORNERS,
    _largest_distance_outside,
    bounded_hull,
    measure_deviation,
)
from drake_clutter.assets.mesh_appearance import simplify_surface
from drake_clutter.built_mesh import read_mesh_measures
from drake_clutter.catalog import ObjectClass, load_catalog
from drake_clutter.cli.app import app
from drake_clutter.config import ClutterConfig
from drake_clutter.export.model_parts import load_inertial, load_visual, write_class_meshes
from drake_clutter.files import InputError
from drake_clutter.scenes.scene import Pose, SceneObject
from drake_clutter.simulation.camera_renderer import CameraRenderer
from drake_clutter.simulation.drake_judge import DrakeJudge
from drake_clutter.visual_mesh import check_visual_mesh

FACE_COLORS = np.array(
    [[200, 30, 30], [30, 200, 30], [30, 30, 200], [200, 200, 30], [30, 200, 200], [200, 30, 200]]
)
"""Colors of the faces +x, -x, +y, -y, +z and -z (sRGB)."""


def own_class(folder: Path, file_name: str, *, repair: bool = False) -> ObjectClass:
    """Build the class of a mesh file in a folder, and return it."""
    text = f"classes:\n  own: {{shape: mesh, mesh: {file_name}, mass_g: 200}}\n"
    (folder / "catalog.yaml").write_text(text)
    build_assets(folder, repair=repair)
    return load_catalog(folder).classes["own"]


def painted_box() -> trimesh.Trimesh:
    """Return a box with a texture of six stripes, one for each face; split at its seams."""
    box = trimesh.creation.box(SIZE)
    axis = np.abs(box.face_normals).argmax(axis=1)
    face = 2 * axis + (box.face_normals.sum(axis=1) < 0)
    image = Image.fromarray(
        np.repeat(np.repeat(FACE_COLORS, 8, axis=0)[:, None], 16, axis=1).astype(np.uint8)
    )
    # v counts from the lower edge in trimesh and OBJ; stripe i is the i-th from above.
    v = 1 - (face + 0.5) / 6
    uv = np.column_stack([np.full(36, 0.5), np.repeat(v, 3)])
    split = trimesh.Trimesh(
        box.triangles.reshape(-1, 3), np.arange(36).reshape(-1, 3), process=False
    )
    material = trimesh.visual.material.SimpleMaterial(image=image)
    split.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    return split


def vertex_colors(mesh: Any) -> NDArray[np.uint8]:
    """Return the colors of the texture at the vertices."""
    return np.asarray(mesh.visual.material.to_color(mesh.visual.uv))


def seen_color(object_class: ObjectClass, R_TO: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the color in the center of the image of an object below the camera (sRGB)."""
    scene = scene_of(SceneObject("own", object_class, Pose.from_rotation(R_TO, (0.0, 0.0, 0.05))))
    image = np.asarray(CameraRenderer(ClutterConfig().cell.camera).render(scene).color)
    row, column = image.shape[0] // 2, image.shape[1] // 2
    center = image[row - 3 : row + 4, column - 3 : column + 4, :3]
    return np.asarray(center.reshape(-1, 3).mean(axis=0), float)


@pytest.mark.parametrize("name", ["box.obj", "box.glb"])
def test_a_textured_model_looks_like_itself(tmp_path: Path, name: str) -> None:
    """Each face has its color towards the camera, also in a glTF file, whose y axis is up."""
    box = painted_box()
    if name.endswith(".glb"):
        box.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0]))
    box.export(tmp_path / name)
    own = own_class(tmp_path, name)
    assert own.size == pytest.approx(SIZE, abs=1e-6)
    x, y, z = np.eye(3)
    for stripe, rows in ((4, [x, y, z]), (5, [x, -y, -z]), (0, [-z, y, x]), (2, [x, -z, y])):
        color = seen_color(own, np.array(rows))
        # The light changes the brightness, but not which channels are strong.
        strong = FACE_COLORS[stripe] > FACE_COLORS[stripe].mean()
        assert np.array_equal(color > color.mean(), strong)


def test_materials_without_textures_keep_their_colors(tmp_path: Path) -> None:
    own = own_class(tmp_path, write_two_materials(tmp_path).name)
    scene = trimesh.load_scene(own.folder / "visual.gltf")
    colors = {
        part.visual.material.baseColorTexture.convert("RGB").getpixel((0, 0))
        for part in scene.geometry.values()
    }
    assert colors == {(255, 0, 0), (0, 0, 255)}
    packed = load_visual(own)  # one mesh with one texture, for exports
    assert len(packed.faces) == 12
    assert {tuple(color[:3]) for color in vertex_colors(packed)} == colors
    (tmp_path / "out").mkdir()
    assert write_class_meshes(own, tmp_path / "out") == ["convex_000"]


def test_vertex_colors_are_kept(tmp_path: Path) -> None:
    box = trimesh.creation.box(SIZE)
    box.visual.vertex_colors = np.tile([12, 200, 100, 255], (8, 1)).astype(np.uint8)
    box.export(tmp_path / "box.ply")
    colors = vertex_colors(load_visual(own_class(tmp_path, "box.ply")))
    assert np.all(colors[:, :3] == [12, 200, 100])


def test_a_missing_texture_is_refused(tmp_path: Path) -> None:
    write_cube_with_seams(tmp_path)
    (tmp_path / "label.png").unlink()
    with pytest.raises(InputError, match=r"file label\.png is missing"):
        own_class(tmp_path, "cube.obj")


def cut_png(data: bytes) -> bytes:
    """Return a PNG file without its last quarter."""
    return data[: 3 * len(data) // 4]


def without_end(data: bytes) -> bytes:
    """Return a PNG file without the end of its last chunk."""
    return data[:-4]


def with_wrong_pixel(data: bytes) -> bytes:
    """Return a PNG file with a bit of its pixels changed."""
    middle = len(data) // 2
    return data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :]


@pytest.mark.parametrize("damage", [cut_png, without_end, with_wrong_pixel])
@pytest.mark.parametrize("name", ["box.obj", "box.glb"])
def test_a_damaged_texture_is_refused(
    tmp_path: Path, name: str, damage: Callable[[bytes], bytes]
) -> None:
    """trimesh would leave it out, and VTK end the process."""
    painted_box().export(tmp_path / name)
    own = own_class(tmp_path, name)
    visual = own.folder / "visual.gltf"
    document = json.loads(visual.read_text())
    kind, _, png = document["images"][0]["uri"].partition(",")
    damaged = base64.b64encode(damage(base64.b64decode(png))).decode()
    document["images"][0]["uri"] = f"{kind},{damaged}"
    visual.write_text(json.dumps(document))
    match = r"visual\.gltf: images\.0: cannot be read .*; expected an image, such as PNG or JPEG"
    for use in (lambda: seen_color(own, np.eye(3)), lambda: load_visual(own)):
        with pytest.raises(InputError, match=match):
            use()

    if name == "box.glb":
        content = (tmp_path / name).read_bytes()
        start = content.index(b"\x89PNG")
        png_size = content.index(b"IEND", start) + 8 - start
        png_bytes = content[start : start + png_size]
        damaged_bytes = damage(png_bytes).ljust(png_size, b"\0")
        (tmp_path / name).write_bytes(content.replace(png_bytes, damaged_bytes))
    else:
        texture = tmp_path / "material_0.png"
        texture.write_bytes(damage(texture.read_bytes()))
    with pytest.raises(InputError, match=r"\.(png|glb: images\.0): cannot be read"):
        build_assets(tmp_path)


@pytest.mark.parametrize(
    ("key", "value", "reason"),
    [
        (("meshes", 0, "primitives", 0, "material"), 1, "it refers to material 1 of 1"),
        (("nodes", 0, "mesh"), 2, "it refers to mesh 2 of 1"),
        (("accessors", 0, "count"), 8, "a triangle has vertex 23 of 8"),
    ],
)
def test_indices_out_of_range_in_a_visual_mesh_are_refused(
    tmp_path: Path, key: tuple[Any, ...], value: int, reason: str
) -> None:
    painted_box().export(tmp_path / "box.glb")
    path = own_class(tmp_path, "box.glb").folder / "visual.gltf"
    check_visual_mesh(path)
    owner = document = json.loads(path.read_text())
    for part in key[:-1]:
        owner = owner[part]
    owner[key[-1]] = value
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match=rf"visual\.gltf: cannot be read \({reason}\)"):
        check_visual_mesh(path)


def test_the_inertia_of_a_mesh_with_seams_is_that_of_a_box(tmp_path: Path) -> None:
    own = own_class(tmp_path, write_cube_with_seams(tmp_path).name)
    x, y, z = SIZE
    moments = 0.2 / 12 * np.array([y * y + z * z, x * x + z * z, x * x + y * y])
    inertial = load_inertial(own)
    assert inertial.mass == 0.2
    assert inertial.inertia[:3] == pytest.approx(moments, rel=1e-5)
    assert inertial.inertia[3:] == pytest.approx(np.zeros(3), abs=1e-10)


def test_two_bodies_of_which_one_is_inside_out_stand_in_drake(tmp_path: Path) -> None:
    inverted = trimesh.creation.box(SIZE)
    inverted.invert()
    inverted.apply_translation([0, 0, 0.08])
    box = trimesh.creation.box(SIZE)
    trimesh.util.concatenate([box, inverted]).export(tmp_path / "two.stl")
    own = own_class(tmp_path, "two.stl")
    moments = np.sort(load_inertial(own).inertia[:3])
    assert moments[2] <= moments[0] + moments[1]
    assert len(own.convex_pieces) >= 2
    pose = Pose.from_rotation(np.eye(3), (0.0, 0.0, own.size[2] / 2))
    assert DrakeJudge(ClutterConfig()).judge(scene_of(SceneObject("own", own, pose)), rng(1)).stable


def test_bodies_that_share_much_of_their_volume_are_refused(tmp_path: Path) -> None:
    box = trimesh.creation.box(SIZE)
    moved = box.copy()
    moved.apply_translation([0.025, 0.001, 0.001])
    trimesh.util.concatenate([box, moved]).export(tmp_path / "two.stl")
    with pytest.raises(InputError, match=r"of its volume is covered twice, .* as at \("):
        own_class(tmp_path, "two.stl")
    assert not (tmp_path / "own").exists()


def test_small_holes_are_closed_on_request(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.04)
    hole = trimesh.triangles.area(ball.triangles).argmin()
    faces = np.delete(ball.faces, hole, axis=0)
    trimesh.Trimesh(ball.vertices, faces, process=False).export(tmp_path / "ball.stl")
    text = "classes:\n  own: {shape: mesh, mesh: ball.stl, mass_g: 200}\n"
    (tmp_path / "catalog.yaml").write_text(text)
    with pytest.raises(InputError, match=r"hole of 3 edges.*assets build --repair"):
        build_assets(tmp_path)
    result = CliRunner().invoke(app, ["assets", "build", str(tmp_path), "--repair"])
    assert result.exit_code == 0, result.output
    assert "closed hole of 3 edges" in " ".join(result.output.split())
    own = load_catalog(tmp_path).classes["own"]
    assert load_inertial(own).inertia[0] == pytest.approx(0.4 * 0.2 * 0.04**2, rel=0.01)


def test_assets_of_an_earlier_mesh_are_refused(tmp_path: Path) -> None:
    trimesh.creation.box(SIZE).export(tmp_path / "box.stl")
    own_class(tmp_path, "box.stl")
    trimesh.creation.box(np.array(SIZE) * 1.5).export(tmp_path / "box.stl")
    load_catalog.cache_clear()
    with pytest.raises(InputError, match="was built from another mesh; run"):
        _ = load_catalog(tmp_path).classes["own"].corners


def test_a_damaged_model_is_refused(tmp_path: Path) -> None:
    trimesh.creation.box(SIZE).export(tmp_path / "box.stl")
    own = own_class(tmp_path, "box.stl")
    own.sdf_path.write_text("<sdf><model>")
    with pytest.raises(InputError, match=r"model\.sdf: cannot be read"):
        _ = own.verified_sdf_path


def test_a_ball_has_a_bounded_number_of_corners(tmp_path: Path) -> None:
    """The hull of 128 of 642 corners lies within the ball, at most 3.5 % of the radius below it."""
    radius = 0.04
    trimesh.creation.icosphere(3, radius).export(tmp_path / "ball.stl")
    ball = own_class(tmp_path, "ball.stl")
    (corners,) = ball.convex_pieces
    assert len(corners) == MAX_PIECE_CORNERS
    assert np.linalg.norm(corners, axis=1) == pytest.approx(radius, abs=1e-6)
    assert np.ptp(corners, axis=0) == pytest.approx(ball.size, abs=1e-6)
    assert ball.mesh is not None
    measures = read_mesh_measures(ball.folder, ball.mesh, 1.0)
    assert measures is not None
    # The lowest plane of the hull is the deepest place of its surface.
    depth = radius + float(ConvexHull(corners).equations[:, 3].max())
    assert measures.max_bulge < 1e-4  # the flat triangles of the icosphere
    assert 0.5 * depth < measures.max_recess <= depth < 0.035 * radius


def test_a_scan_stands_on_its_flat_foot() -> None:
    """A ball of 40 mm is cut 26 mm below its center; the foot has a radius of 30 mm.

    The rim of the foot is jagged. Where two of 32 directions have the same corner, the outline lies
    up to 1 - cos(11.25 deg) = 1.9 % of the radius inside.
    """
    scan = trimesh.creation.icosphere(4, 0.04)
    scan.vertices[:, 2] = np.maximum(scan.vertices[:, 2], -0.026)
    hull = bounded_hull(scan.vertices)
    assert len(hull.vertices) <= MAX_PIECE_CORNERS
    foot = hull.vertices[hull.vertices[:, 2] < -0.026 + 5e-5]
    outline = ConvexHull(foot[:, :2])
    inner_radius = -outline.equations[:, 2].max()
    full = ConvexHull(scan.vertices[scan.vertices[:, 2] == -0.026, :2])
    assert inner_radius > 0.981 * -full.equations[:, 2].max() > 0.028
    largest = hull.facets_area.argmax()
    assert hull.facets_normal[largest] == pytest.approx([0.0, 0.0, -1.0], abs=1e-9)


def test_round_ends_stay_flat() -> None:
    can = trimesh.creation.cylinder(0.035, 0.1, sections=600)
    hull = bounded_hull(can.vertices)
    for end in (-0.05, 0.05):
        corners = hull.vertices[np.abs(hull.vertices[:, 2] - end) < 1e-9]
        assert ConvexHull(corners[:, :2]).volume > 0.985 * np.pi * 0.035**2


def test_the_distance_of_points_outside_of_a_box() -> None:
    box = trimesh.creation.box((0.2, 0.2, 0.2))
    points = np.array([[0.0, 0.0, 0.05], [0.103, 0.05, 0.0], [0.101, 0.101, 0.101]])
    assert _largest_distance_outside(box, points) == pytest.approx(0.003)
    assert _largest_distance_outside(box, points[[0, 2]]) == pytest.approx(0.001 * 3**0.5)
    assert _largest_distance_outside(box, points[:1]) == 0.0


def test_a_scan_with_folds_is_measured() -> None:
    """Drake measures no distances from meshes whose triangles turn back."""
    scan = trimesh.creation.icosphere(3, 0.04)
    scan.vertices += rng(0).normal(0, 0.002, scan.vertices.shape)
    bulge, recess = measure_deviation(scan, [bounded_hull(scan.vertices)])
    assert 0.001 < bulge < 0.012
    assert 0.0 <= recess < 0.002


def test_a_simplified_surface_keeps_its_shape_and_texture() -> None:
    """A ball with a flat foot; its texture is a picture seen from above."""
    ball = trimesh.creation.icosphere(5, 0.04)
    points = np.maximum(ball.vertices, [-1.0, -1.0, -0.026])
    uv = points[:, :2] * 10 + 0.5
    few, triangles, values = simplify_surface(points, ball.faces, uv[ball.faces], 2000)
    assert 1000 < len(triangles) <= 2000
    used = few[np.unique(triangles)]
    assert used[:, 2].min() == pytest.approx(-0.026, abs=1e-9)
    is_round = used[:, 2] > -0.024
    assert np.linalg.norm(used[is_round], axis=1) == pytest.approx(0.04, abs=2e-4)
    assert values == pytest.approx(few[triangles][:, :, :2] * 10 + 0.5)
    simple = trimesh.Trimesh(few, triangles)
    assert simple.volume == pytest.approx(trimesh.Trimesh(points, ball.faces).volume, rel=0.02)


def test_colors_on_both_sides_of_a_seam_stay_apart() -> None:
    """Two patches of one plane, red and blue, share the places of the seam but no vertices."""
    x, y = (each.ravel() for each in np.meshgrid(np.linspace(0, 1, 21), np.linspace(0, 1, 21)))
    left = np.column_stack([x, y, np.zeros(441)])
    corner = np.flatnonzero((x < 0.99) & (y < 0.99))
    half = np.vstack(
        [
            np.column_stack([corner, corner + 1, corner + 22]),
            np.column_stack([corner, corner + 22, corner + 21]),
        ]
    )
    triangles = np.vstack([half, half + 441])
    colors = np.zeros((len(triangles), 3, 3))
    colors[: len(half), :, 0] = colors[len(half) :, :, 2] = 255
    both = np.vstack([left - [1, 0, 0], left])
    _, few, values = simplify_surface(both, triangles, colors, 400)
    assert 100 < len(few) <= 400
    assert {tuple(color) for color in values.reshape(-1, 3)} == {(255, 0, 0), (0, 0, 255)}


def test_a_scanned_box_is_one_piece(tmp_path: Path) -> None:
    """Noise of 0.1 mm is below the depth up to which a mesh counts as convex."""
    box = trimesh.creation.box(SIZE)
    for _ in range(3):
        box = box.subdivide()
    box.vertices += rng(0).normal(0, 1e-4, (len(box.vertices), 3))
    box.export(tmp_path / "box.ply")
    own = own_class(tmp_path, "box.ply")
    (corners,) = own.convex_pieces
    assert len(corners) <= MAX_PIECE_CORNERS
    assert own.size == pytest.approx(SIZE, abs=1e-3)


@pytest.mark.parametrize(("margin", "expected"), [(0.001, (3**0.5, 0)), (-0.001, (0, 3**0.5))])
def test_deviation_of_a_box_that_is_a_millimeter_larger_or_smaller_all_around(
    margin: float, expected: tuple[float, float]
) -> None:
    """The largest distance is at the corners."""
    mesh = trimesh.creation.box((0.04, 0.05, 0.06))
    piece = trimesh.creation.box(np.array((0.04, 0.05, 0.06)) + 2 * margin)
    deviation = np.array(measure_deviation(mesh, [piece]))
    assert deviation == pytest.approx(np.array(expected) * 0.001, abs=1e-9)


def test_a_built_mesh_is_not_read_again_unless_it_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trimesh.creation.box((0.04, 0.05, 0.06)).export(tmp_path / "box.stl")
    own_class(tmp_path, "box.stl")
    with monkeypatch.context() as context:
        context.setattr(trimesh, "load_scene", None)
        load_catalog.cache_clear()
        own = load_catalog(tmp_path).classes["own"]
        assert own.size == pytest.approx((0.04, 0.05, 0.06))
        assert np.ptp(own.surface_triangles.reshape(-1, 3), axis=0) == pytest.approx(own.size)
    trimesh.creation.box((0.05, 0.05, 0.06)).export(tmp_path / "box.stl")
    load_catalog.cache_clear()
    assert load_catalog(tmp_path).classes["own"].size == pytest.approx((0.05, 0.05, 0.06))


@pytest.mark.parametrize("name", ["mesh.json", "surface.npy"])
def test_damaged_measures_of_a_mesh_are_not_used(tmp_path: Path, name: str) -> None:
    trimesh.creation.box((0.04, 0.05, 0.06)).export(tmp_path / "box.stl")
    path = own_class(tmp_path, "box.stl").folder / name
    path.write_bytes(path.read_bytes()[:-9])
    load_catalog.cache_clear()
    own = load_catalog(tmp_path).classes["own"]
    assert own.size == pytest.approx((0.04, 0.05, 0.06))
    assert own.surface_triangles.shape == (12, 3, 3)


def test_a_closed_cavity_is_filled(tmp_path: Path) -> None:
    """A hollow bottle has the collision geometry of a solid one, and the mass of its wall."""
    outer, inner = (
        trimesh.creation.revolve(np.array(outline), sections=24)
        for outline in (
            [(0, 0), (0.035, 0), (0.035, 0.12), (0.014, 0.15), (0.014, 0.2), (0, 0.2)],
            [(0, 0.003), (0.032, 0.003), (0.032, 0.118), (0.011, 0.15), (0.011, 0.197), (0, 0.197)],
        )
    )
    solid = outer.volume
    cavity = inner.volume
    inner.invert()
    trimesh.util.concatenate([outer, inner]).export(tmp_path / "bottle.stl")
    bottle = own_class(tmp_path, "bottle.stl")
    hulls = [trimesh.convex.convex_hull(corners) for corners in bottle.convex_pieces]
    assert sum(hull.volume for hull in hulls) == pytest.approx(solid, rel=0.02)
    expected = (solid * outer.center_mass[2] - cavity * inner.center_mass[2]) / (solid - cavity)
    assert bottle.center_of_mass[2] == pytest.approx(expected - 0.1, abs=1e-6)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        (
            "MAX_DECOMPOSITION_TIME",
            0.01,
            r"CoACD found no convex pieces within 0\.01 s; reduce its",
        ),
        (
            "_COACD_OPTIONS",
            {"no": 1},
            r"CoACD failed with exit code 1 \(TypeError: .*\); reduce its",
        ),
    ],
)
def test_a_decomposition_that_fails_is_one_line(
    name: str, value: Any, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(convex_pieces, name, value)
    outline = [(0, 0), (0.06, 0), (0.07, 0.036), (0.066, 0.036), (0.056, 0.006), (0, 0.006)]
    trimesh.creation.revolve(np.array(outline)).export(tmp_path / "bowl.stl")
    with pytest.raises(InputError, match=rf"catalog\.yaml: classes\.own\.mesh: {message}"):
        own_class(tmp_path, "bowl.stl")


def test_a_mesh_in_millimeters_has_the_size_of_the_object(tmp_path: Path) -> None:
    box = trimesh.creation.box(1000 * np.array(SIZE))
    box.export(tmp_path / "box.obj")
    text = "classes:\n  own: {shape: mesh, mesh: box.obj, mesh_unit: mm, mass_g: 120}\n"
    (tmp_path / "catalog.yaml").write_text(text)
    assert load_catalog(tmp_path).classes["own"].size == pytest.approx(SIZE)
    build_assets(tmp_path)
    load_catalog.cache_clear()
    own = load_catalog(tmp_path).classes["own"]
    assert own.size == pytest.approx(SIZE)
    assert np.ptp(own.surface_triangles.reshape(-1, 3), axis=0) == pytest.approx(SIZE)
    assert np.ptp(own.corners, axis=0) == pytest.approx(SIZE)
    # The built measures are those of another unit, and are not used.
    (tmp_path / "catalog.yaml").write_text(text.replace("unit: mm", "unit: m"))
    load_catalog.cache_clear()
    with pytest.raises(InputError, match=r"is it in mm\? Set `mesh_unit: mm` of the class"):
        load_catalog(tmp_path)
    (tmp_path / "catalog.yaml").write_text(
        "classes:\n  own: {shape: box, size_mm: [9, 9, 9], mesh_unit: mm, mass_g: 120}\n"
    )
    with pytest.raises(InputError, match="`mesh_unit` of a mesh alone"):
        load_catalog(tmp_path)
