"""Meshes of a user: static judge, rays and Drake."""

# trimesh is typed in part only.
# mypy: allow-untyped-calls

import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import trimesh
from conftest import resting, rng, scene_of
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation
from test_settle import BELOW
from test_static_judge import STEP

from drake_clutter.assets import build_assets
from drake_clutter.catalog import ObjectClass, load_catalog
from drake_clutter.config import ClutterConfig
from drake_clutter.grammar import Orientation
from drake_clutter.planning.place_check import resting_tilt
from drake_clutter.scenes.geometry import objects_resting_on
from drake_clutter.scenes.interfaces import (
    Detection,
    InconclusiveReason,
    InconclusiveVerdict,
    Instability,
    InstabilityReason,
    Move,
    MoveResult,
    Verdict,
)
from drake_clutter.scenes.placement import has_clear_top, resolve_placement
from drake_clutter.scenes.scene import TRAY, Pose, SceneObject
from drake_clutter.simulation.camera_renderer import CameraRenderer
from drake_clutter.simulation.drake_judge import DrakeJudge
from drake_clutter.stability.contacts import contact_polygon
from drake_clutter.stability.ray_caster import RayCaster
from drake_clutter.stability.shape_table import ShapeTable, orient_shape
from drake_clutter.stability.static_executor import StaticExecutor
from drake_clutter.stability.static_judge import StaticStabilityJudge


def hull(corners: NDArray[np.float64]) -> trimesh.Trimesh:
    made: trimesh.Trimesh = trimesh.convex.convex_hull(corners)
    return made


def regular(sides: int, radius: float, z: float) -> NDArray[np.float64]:
    angle = np.arange(sides) * (2 * math.pi / sides)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(sides, z)])


ASKEW = Rotation.from_euler("zyx", (40, 40, 40), degrees=True).as_matrix()


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> dict[str, ObjectClass]:
    """Return a hexagonal prism, a frustum, a wedge, an oblique box, and a bracket.

    The wedge is high at -x. The bracket is not convex.
    """
    folder = tmp_path_factory.mktemp("user") / "own"
    folder.mkdir()
    wedge = [
        [x, y, z] for y in (-0.03, 0.03) for x, z in ((-0.06, 0.0), (0.06, 0.0), (-0.06, 0.08))
    ]
    outline = [[0.0, 0.0], [0.10, 0.0], [0.10, 0.03], [0.03, 0.03], [0.03, 0.08], [0.0, 0.08]]
    corners = [[x, y, z] for y in (-0.03, 0.03) for x, z in outline]
    front = [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]]
    sides = [
        triangle
        for i in range(6)
        for j in [(i + 1) % 6]
        for triangle in ([i, i + 6, j], [j, i + 6, j + 6])
    ]
    bracket = trimesh.Trimesh(corners, front + [[6 + c, 6 + b, 6 + a] for a, b, c in front] + sides)
    bracket.fix_normals()
    meshes = {
        "prism": hull(np.vstack([regular(6, 0.05, z) for z in (0.0, 0.07)])),
        "frustum": hull(np.vstack([regular(4, 0.06, 0.0), regular(4, 0.03, 0.06)])),
        "wedge": hull(np.array(wedge)),
        "bracket": bracket,
        "askew": hull(
            np.array(list(product((-0.025, 0.025), (-0.030, 0.030), (-0.035, 0.035)))) @ ASKEW.T
        ),
    }
    for name, mesh in meshes.items():
        mesh.export(folder / f"{name}.stl")
    entries = [f"  {name}: {{shape: mesh, mesh: {name}.stl, mass_g: 200}}\n" for name in meshes]
    (folder / "catalog.yaml").write_text("classes:\n" + "".join(entries))
    build_assets(folder)
    catalog = load_catalog(folder)
    return {name: catalog.classes[name] for name in meshes}


@pytest.fixture(scope="module")
def cups(tmp_path_factory: pytest.TempPathFactory) -> dict[str, ObjectClass]:
    """Return square cups of 100 and 160 mm, 60 mm high, with a floor and walls of 10 mm.

    Their five boxes share no edges, so each is a convex piece.
    """
    folder = tmp_path_factory.mktemp("user") / "cups"
    folder.mkdir()
    for name, side in (("cup", 0.100), ("bowl", 0.160)):
        slab = trimesh.creation.box((side - 0.0002, side - 0.0002, 0.01))
        walls = []
        for k in range(4):
            wall = trimesh.creation.box((0.01, side - 0.0101, 0.05))
            wall.apply_translation((side / 2 - 0.005, 0.0049, 0.03))
            turn = trimesh.transformations.rotation_matrix(k * math.pi / 2, (0, 0, 1))
            walls.append(wall.apply_transform(turn))
        trimesh.util.concatenate([slab, *walls]).export(folder / f"{name}.stl")
    entries = [
        f"{name}: {{shape: mesh, mesh: {name}.stl, mass_g: 300}}" for name in ("cup", "bowl")
    ]
    (folder / "catalog.yaml").write_text(f"classes: {{{', '.join(entries)}}}")
    build_assets(folder)
    classes = load_catalog(folder).classes
    return {name: classes[name] for name in ("cup", "bowl")}


def as_made(
    object_class: ObjectClass,
    xy: tuple[float, float],
    floor: float,
    degrees: float = 0.0,
    name: str = "own",
) -> SceneObject:
    """Return an object standing on its z axis, rotated about it."""
    R_TO = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    return SceneObject(
        name,
        object_class,
        Pose.from_rotation(R_TO, (*xy, floor - float(object_class.corners[:, 2].min()))),
    )


@pytest.mark.parametrize(
    ("class_name", "x", "degrees", "stable"),
    [
        ("prism", 0.105, 10.0, True),
        ("prism", 0.125, 10.0, False),
        ("frustum", 0.123, 0.0, False),
        # A wedge's center of mass is a third of the way from its high end: 20 mm off its center.
        ("wedge", 0.123, 0.0, True),
        ("wedge", 0.107, 180.0, False),
    ],
)
def test_own_meshes_near_the_edge_of_a_box(
    class_name: str,
    x: float,
    degrees: float,
    stable: bool,
    own: dict[str, ObjectClass],
    static_judge: StaticStabilityJudge,
    judge: DrakeJudge,
) -> None:
    """Objects overhang the edge at 115 mm."""
    scene = scene_of(BELOW, as_made(own[class_name], (x, 0.0), 0.060, degrees))
    mine, drakes = static_judge.judge(scene, rng(1)), judge.judge(scene, rng(1))
    assert isinstance(mine, Verdict)
    assert mine.stable is drakes.stable is stable
    assert mine.visible_fractions == pytest.approx(drakes.visible_fractions, abs=0.01)


@pytest.mark.parametrize(("x", "stable"), [(0.012, True), (0.030, False)])
def test_a_box_on_a_frustums_small_top(
    x: float,
    stable: bool,
    own: dict[str, ObjectClass],
    static_judge: StaticStabilityJudge,
    judge: DrakeJudge,
) -> None:
    """The top face, a rotated square of 42 mm, carries; the outline would carry more."""
    scene = scene_of(
        as_made(own["frustum"], (0.0, 0.0), 0.0),
        resting("gelatin_box", xy=(x, 0.0), floor=0.060, name="box"),
    )
    mine = static_judge.judge(scene, rng(1))
    assert isinstance(mine, Verdict)
    assert mine.stable is judge.judge(scene, rng(1)).stable is stable


def test_margins_of_own_meshes(
    own: dict[str, ObjectClass], static_judge: StaticStabilityJudge
) -> None:
    """The margin is the distance from the center of mass to the nearest side.

    Of a hexagon, it is the inner radius; of the wedge, it is 40 mm from the high end.
    """
    for class_name, margin in (
        ("prism", 0.050 * math.cos(math.pi / 6)),
        ("frustum", 0.060 * math.cos(math.pi / 4)),
        ("wedge", 0.03),
    ):
        found = static_judge.stability_margins(
            scene_of(as_made(own[class_name], (0.1, 0.0), 0.0, 20.0))
        )
        assert not isinstance(found, InconclusiveVerdict)
        assert found["own"] == pytest.approx(margin, abs=1.01 * STEP)
    over = static_judge.stability_margins(
        scene_of(BELOW, as_made(own["wedge"], (0.123, 0.0), 0.060))
    )
    assert not isinstance(over, InconclusiveVerdict)
    assert over["own"] == pytest.approx(0.115 - (0.123 - 0.020), abs=1.01 * STEP)


def test_a_mesh_stands_on_a_face_askew_in_its_frame(
    own: dict[str, ObjectClass], static_judge: StaticStabilityJudge
) -> None:
    """The oblique box stands on each of its six faces."""
    for turn in ("x", 0), ("x", 90), ("x", 180), ("x", 270), ("y", 90), ("y", 270):
        R_TO = Rotation.from_euler(*turn, degrees=True).as_matrix() @ ASKEW.T
        lowest = float((own["askew"].corners @ R_TO.T)[:, 2].min())
        margins = static_judge.stability_margins(
            scene_of(
                SceneObject("own", own["askew"], Pose.from_rotation(R_TO, (0.0, 0.0, -lowest)))
            )
        )
        assert not isinstance(margins, InconclusiveVerdict)
        assert margins["own"] >= 0.025 - 1.01 * STEP, turn


def test_nothing_stands_on_a_slope(
    own: dict[str, ObjectClass], static_judge: StaticStabilityJudge
) -> None:
    found = static_judge.find_instability(
        scene_of(
            as_made(own["wedge"], (0.0, 0.0), 0.0), resting("gelatin_box", floor=0.080, name="box")
        )
    )
    assert found == InconclusiveVerdict(InconclusiveReason.EDGE_CONTACT, "box")


def test_the_caster_sees_own_meshes_as_the_camera_does(
    own: dict[str, ObjectClass], config: ClutterConfig
) -> None:
    """Visible fractions agree with the renderer in any orientation, but for single pixels."""
    turns = Rotation.random(4, rng=rng(2)).as_matrix()
    tumbled = [
        SceneObject(name, own[name], Pose.from_rotation(turn, (x, 0.02, 0.15)))
        for name, turn, x in zip(
            ("prism", "bracket", "wedge"), turns, (-0.12, 0.0, 0.11), strict=False
        )
    ]
    scene = scene_of(*tumbled, resting("sugar_box", xy=(0.05, 0.0), floor=0.25, name="before"))
    shares = RayCaster(config.cell.camera).visible_fractions(scene.objects)
    assert shares == pytest.approx(
        CameraRenderer(config.cell.camera).visible_fractions(scene), abs=0.01
    )
    assert sum(0.02 < share < 0.98 for share in shares.values()) >= 2


@pytest.mark.parametrize(("x", "stable"), [(0.120, True), (0.134, False)])
def test_a_bracket_stands_by_its_center_of_mass(
    x: float,
    stable: bool,
    own: dict[str, ObjectClass],
    static_judge: StaticStabilityJudge,
    judge: DrakeJudge,
) -> None:
    """The center of mass of the L is 11.7 mm off that of its bounding box, the edge at 115 mm.

    Its area is 100 x 30 and 30 x 50 mm, with centers at x = 50 and 15 mm from its left side.
    """
    assert own["bracket"].center_of_mass[0] == pytest.approx(
        (3000 * 50 + 1500 * 15) / 4.5e6 - 0.050
    )
    scene = scene_of(BELOW, as_made(own["bracket"], (x, 0.0), 0.060))
    mine, drakes = static_judge.judge(scene, rng(1)), judge.judge(scene, rng(1))
    assert isinstance(mine, Verdict)
    assert mine.stable is drakes.stable is stable
    assert mine.visible_fractions == pytest.approx(drakes.visible_fractions, abs=0.01)


@pytest.mark.parametrize(
    ("overlap", "margin", "expected"),
    [
        (0.001, 0.0, (-0.021, -0.020)),  # narrower than 2 mm, but the only contact
        (0.010, 0.002, (-0.027, -0.023)),
        (0.006, 0.004, (-0.023, -0.023)),  # its center line
        (0.006, 0.006, None),
        (-0.001, 0.0, None),
    ],
)
def test_the_contact_with_the_wall_of_a_bracket(
    overlap: float,
    margin: float,
    expected: tuple[float, float] | None,
    own: dict[str, ObjectClass],
) -> None:
    """The wall ends 20 mm left of the center. 1 mm at each side of a wider contact is left out."""
    bracket = as_made(own["bracket"], (0.0, 0.0), 0.0)
    box = resting("gelatin_box", xy=(-0.020 - overlap + 0.085 / 2, 0.0), floor=0.080)
    shapes = ShapeTable()
    rows, p_T = shapes.rows_and_positions([bracket, box])
    table = shapes.arrays.table
    polygon = contact_polygon(table, rows[0], rows[1], p_T[0], p_T[1], margin)
    if expected is None:
        assert len(polygon) == 0
        return
    assert (polygon[:, 0].min(), polygon[:, 0].max()) == pytest.approx(expected, abs=3e-5)


@pytest.mark.parametrize("xy", list(product((-0.25, 0.25), repeat=2)))
def test_rays_to_a_bracket_do_not_depend_on_earlier_scenes(
    xy: tuple[float, float], own: dict[str, ObjectClass], config: ClutterConfig
) -> None:
    bracket = as_made(own["bracket"], xy, 0.0)
    cover = resting("cereal_box_large", xy=xy, floor=0.2, name="cover")
    beside = resting("gelatin_box", xy=(xy[0] - 0.03, xy[1]), floor=0.1, name="beside")
    expected = RayCaster(config.cell.camera).visible_fractions([bracket, beside])
    assert 0.2 < expected[bracket.name] < 0.8
    caster = RayCaster(config.cell.camera)
    assert caster.visible_fractions([bracket, cover])[bracket.name] < 0.5
    assert caster.visible_fractions([bracket, beside]) == expected


@pytest.mark.parametrize(
    ("x", "expected"), [(0.022, 0.0280), (0.040, 0.0100), (0.055, -0.0050), (-0.010, "overlap")]
)
def test_a_box_on_the_low_arm_of_a_bracket(
    x: float,
    expected: float | str,
    own: dict[str, ObjectClass],
    static_judge: StaticStabilityJudge,
) -> None:
    """The arm is 30 mm high and ends 50 mm from the center; the wall ends 20 mm before it.

    The box is 28 mm thick and stands upright, its center x from that of the bracket.
    """
    box = resting("gelatin_box", Orientation.UPRIGHT_90, (x, 0.0), 0.030, "box")
    assert np.ptp(box.corners_T[:, 0]) == pytest.approx(0.028)
    scene = scene_of(as_made(own["bracket"], (0.0, 0.0), 0.0, name="bracket"), box)
    supports = static_judge.find_supports(scene)
    if expected == "overlap":
        assert isinstance(supports, InconclusiveVerdict)
        assert supports.reason is InconclusiveReason.INTERPENETRATING
        return
    assert supports == {"bracket": frozenset({TRAY}), "box": frozenset({"bracket"})}
    margins = static_judge.stability_margins(scene)
    assert not isinstance(margins, InconclusiveVerdict)
    # The box's own half thickness of 14 mm bounds the margin, too.
    assert margins["box"] == pytest.approx(min(float(expected), 0.014), abs=0.0011)


def test_a_can_over_the_mouth_of_a_cup_falls_in(
    cups: dict[str, ObjectClass], static_judge: StaticStabilityJudge, judge: DrakeJudge
) -> None:
    """Nothing is below the can but the floor of the cup; a wider box rests on the rim."""
    cup = as_made(cups["cup"], (0.0, 0.0), 0.0, name="cup")
    can = resting("tomato_soup_can", floor=0.060, name="can")
    found = static_judge.find_instability(scene_of(cup, can))
    assert found == Instability(InstabilityReason.UNSUPPORTED, "can")
    assert not judge.judge(scene_of(cup, can), rng(1)).stable
    box = resting("cracker_box", floor=0.060, name="box")
    assert static_judge.find_instability(scene_of(cup, box)) is None
    inside = scene_of(cup, resting("tomato_soup_can", floor=0.010, name="can"))
    assert static_judge.find_supports(inside) == {
        "cup": frozenset({TRAY}),
        "can": frozenset({"cup"}),
    }
    assert static_judge.find_instability(inside) is None


@pytest.mark.parametrize(
    ("cup_class", "picked", "floor"),
    [
        ("cup", "cracker_box", 0.060),  # across the mouth, on the rim
        ("cup", "tomato_soup_can", None),  # neither on the rim nor, with its clearance, in the cup
        ("bowl", "tomato_soup_can", 0.010),  # into the bowl
        ("bowl", "sugar_box", 0.060),  # 175 x 89 mm: on two sides of the rim
    ],
)
def test_what_is_put_on_or_into_a_cup(
    cup_class: str,
    picked: str,
    floor: float | None,
    cups: dict[str, ObjectClass],
    config: ClutterConfig,
    static_judge: StaticStabilityJudge,
) -> None:
    cup = as_made(cups[cup_class], (0.1, 0.05), 0.0, name="cup")
    scene = scene_of(cup, resting(picked, xy=(-0.15, 0.0), name="picked"))
    observation, _ = static_judge.ray_caster.observe(scene)
    move = Move("picked", "cup")
    command = resolve_placement(move, observation, config.exploration, rng(0))
    if floor is None:
        assert command is None
        return
    assert command is not None
    placed = replace(scene["picked"], X_TO=command.X_TO_place)
    assert placed.bounds_T[0][2] == pytest.approx(floor + 0.001, abs=2e-4)
    assert placed.X_TO.p[:2] == pytest.approx([0.1, 0.05], abs=0.006)
    outcome = StaticExecutor(config, static_judge).execute(scene, command, rng(0))
    assert outcome.result is MoveResult.PLACED
    assert static_judge.find_supports(outcome.scene) == {
        "cup": frozenset({TRAY}),
        "picked": frozenset({"cup"}),
    }
    resting_objects = objects_resting_on(outcome.scene["cup"], outcome.scene.objects)
    assert resting_objects == ("picked",)
    assert not has_clear_top(static_judge.ray_caster.observe(outcome.scene)[0], detected(cup))


def detected(o: SceneObject) -> Detection:
    """Return an object as a detection without pixels."""
    return Detection(o.name, o.object_class, o.X_TO, np.zeros((1, 1), np.bool_))


def test_the_top_of_a_bracket_is_that_of_its_wall(own: dict[str, ObjectClass]) -> None:
    """The wall is 30 mm thick and 60 mm wide, at the left end of 100 mm, and 80 mm high."""
    shape = orient_shape(own["bracket"], (1.0, 0.0, 0.0, 0.0))
    assert shape.top_z == pytest.approx(0.040, abs=1e-5)
    assert shape.top.min(axis=0) == pytest.approx([-0.050, -0.030], abs=1e-5)
    assert shape.top.max(axis=0) == pytest.approx([-0.020, 0.030], abs=1e-5)


def test_a_mesh_on_any_of_its_faces_is_not_tilted(own: dict[str, ObjectClass]) -> None:
    """The product of a normal with itself may exceed 1 by rounding."""
    for object_class in own.values():
        for normal in ConvexHull(object_class.corners).equations[:, :3]:
            side = np.cross(normal, [0.0, 0.0, 1.0] if abs(normal[2]) < 0.9 else [1.0, 0.0, 0.0])
            side /= np.linalg.norm(side)
            rotation = np.array([side, np.cross(-normal, side), -normal])
            assert resting_tilt(object_class, rotation) == pytest.approx(0.0, abs=1e-7)
