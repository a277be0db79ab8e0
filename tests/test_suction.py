"""Suction gripper: seals, load ratios and accelerations, against analytical values."""

# trimesh is typed in part only.
# mypy: allow-untyped-calls

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from conftest import CLASSES, DEFAULT_CELL, cell_with, own_mesh_class, resting
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

from drake_clutter.catalog import RestOrientation, Shape, load_catalog
from drake_clutter.cell.gripper import (
    Grasp,
    GraspFailure,
    GraspFailureReason,
    GraspSampling,
    Gripper,
    LazyGrasps,
)
from drake_clutter.cell.lip_seal import lip_flatness_deviation, lip_surface_profile, profile_tilt
from drake_clutter.cell.payload_limits import DOWN_G, GRAVITY, payload_wrench
from drake_clutter.cell.suction import (
    MAX_SEAL_GAP,
    SuctionGripper,
)
from drake_clutter.files import InputError
from drake_clutter.simulation.scene_plant import rigid_transform
from drake_clutter.validation import validate

SUCTION = SuctionGripper.model_validate({"cup_diameter": 0.025})
CUP = SUCTION.cups[0]
ALONG_MINUS_X = RotationMatrix(np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]))
SAMPLING = GraspSampling(spacing=0.012, lip_gap=0.0005, max_grasps=9, min_payload_acceleration=0.3)


def test_fields_of_a_single_cup_change_or_replace_the_cups() -> None:
    """Files of earlier versions have them; several settings add up."""
    gripper = cell_with("gripper.cup_diameter=0.015", "gripper.extension=0.2").gripper
    assert isinstance(gripper, SuctionGripper)
    (cup,) = gripper.cups
    assert (cup.diameter, cup.extension, cup.length) == (0.015, 0.2, 0.020)
    assert cup.X_FG.transform.translation() == pytest.approx([0.0, 0.0, 0.1023 + 0.2 + 0.020])


def two_cups(**small: Any) -> SuctionGripper:
    cups = [dict(CUP), {"name": "small", "X_FG": {"translation": [0.0, 0.05, 0.2143]}, **small}]
    return validate(SuctionGripper, {"cups": cups}, "gripper")


@pytest.mark.parametrize(
    ("small", "message"),
    [
        ({"name": "single"}, "single: a cup's name; expected names that differ"),
        ({"name": "a b"}, r"cups\[1\]\.name: 'a b'; expected"),
        ({"diameter": 0.001}, r"cups\[1\]\.diameter: 0\.001; expected .* from 0\.005 to 0\.1"),
        ({"tilt": 1}, r"cups\[1\]\.tilt: is unknown"),
    ],
)
def test_invalid_cups(small: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        two_cups(**small)


def test_the_model_of_a_gripper_has_a_frame_and_a_mass_for_each_cup() -> None:
    gripper = two_cups(diameter=0.01, length=0.012, extension=0.1, tube_radius=0.005)
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModelsFromString(gripper.model_sdf(compliant=False, actuated=False), "sdf")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("body"))
    plant.Finalize()
    context = plant.CreateDefaultContext()
    for tool in gripper.tools.values():
        X_FG = plant.GetFrameByName(tool.frame).CalcPoseInWorld(context)
        assert X_FG.IsNearlyEqualTo(tool.X_FG, 1e-9)
    bar = 2700.0 * math.pi * 0.008**2 * 0.05
    tubes = 0.05 + 0.05 * 0.5**2
    cups = 0.02 + 0.02 * (0.01 / 0.025) ** 2
    assert gripper.mass == pytest.approx(0.71 + bar + tubes + cups)
    assert plant.CalcTotalMass(context) == pytest.approx(gripper.mass, rel=1e-4)


def on_top(height: float, x: float = 0.0, tilt: float = 0.0) -> RigidTransform:
    """Return X_OG of a cup that points down, at height and x [m], tilted about y [rad]."""
    c, s = math.cos(tilt), math.sin(tilt)
    R = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ np.diag([1.0, -1.0, -1.0])
    return RigidTransform(RotationMatrix(R), [x, 0.0, height])


def test_a_flat_face_seals() -> None:
    box, can = CLASSES["cracker_box"], CLASSES["tomato_soup_can"]
    assert lip_flatness_deviation(box, on_top(0.115), CUP.diameter) == pytest.approx(0.0, abs=1e-12)
    assert lip_flatness_deviation(
        can, on_top(0.0505, x=0.033 - 0.0130), CUP.diameter
    ) == pytest.approx(0.0, abs=1e-12)


def test_an_edge_does_not_seal() -> None:
    """The rim of a can, and a face that is narrower than the cup, do not seal."""
    assert (
        lip_flatness_deviation(CLASSES["tomato_soup_can"], on_top(0.0505, x=0.025), CUP.diameter)
        == math.inf
    )
    onto_side = np.array([[0.0, 1, 0], [0, 0, -1], [-1, 0, 0]]).T  # 28 mm deep
    narrow = RigidTransform(RotationMatrix(onto_side), [0.0, 0.0425, 0.0])
    assert lip_flatness_deviation(CLASSES["gelatin_box"], narrow, 0.030) == math.inf


def test_tilt_and_curvature_are_told_apart() -> None:
    """A plane deviates by nothing at any tilt, a cylinder by r - sqrt(r^2 - d^2 / 4)."""
    box = CLASSES["cracker_box"]
    for degrees in (0.0, 5.0, 20.0):
        X_OG = on_top(0.115, tilt=math.radians(degrees))
        assert lip_flatness_deviation(box, X_OG, CUP.diameter) == pytest.approx(0.0, abs=1e-12)
        tilt = profile_tilt(lip_surface_profile(box, X_OG, CUP.diameter), CUP.diameter)
        assert math.degrees(tilt) == pytest.approx(degrees, abs=1e-6)
        assert SUCTION.can_attach("single", box, X_OG) is (degrees <= SUCTION.max_tilt_deg)
    side = RigidTransform(ALONG_MINUS_X, [0.033, 0.0, 0.0])
    sagitta = 0.033 - math.sqrt(0.033**2 - 0.0125**2)
    assert lip_flatness_deviation(CLASSES["tomato_soup_can"], side, 0.025) == pytest.approx(
        sagitta, rel=0.1
    )  # of a prism of 32 sides


def test_grasps_follow_the_normal_of_a_tilted_face() -> None:
    """The lip touches the face, and the load has gravity in its true direction."""
    box = CLASSES["pudding_box"]
    tilt = math.radians(25)
    R_TO = RotationMatrix.MakeYRotation(tilt) @ RotationMatrix.MakeYRotation(math.pi / 2)
    X_TO = RigidTransform(R_TO, [0.1, -0.1, 0.08])
    found = SUCTION.sample_grasps(box, X_TO, SAMPLING)
    assert not isinstance(found, GraspFailure)
    normal = R_TO.matrix()[:, 0]  # of the face of the shortest side
    normal = normal * np.sign(normal[2])
    for grasp in found:
        assert grasp.X_TG.rotation().matrix()[:, 2] == pytest.approx(-normal, abs=1e-9)
        p_OG = X_TO.inverse() @ grasp.X_TG.translation()
        assert abs(p_OG[0]) == pytest.approx(box.size[0] / 2, abs=1e-9)
        p_GCm = grasp.X_TG.inverse() @ X_TO.translation()
        down_G = np.array(grasp.X_TG.rotation().inverse() @ np.array([0.0, 0.0, -1.0]))
        assert down_G[2] == pytest.approx(math.cos(tilt))
        force, moment = payload_wrench(box.mass, p_GCm, down_G, np.zeros(3))
        ratio = SUCTION.load_ratio("single", force, moment)
        assert ratio * SUCTION.safety < 1
        assert np.linalg.norm(force) == pytest.approx(box.mass * GRAVITY)
    steep = RigidTransform(RotationMatrix.MakeXRotation(math.radians(60)), [0.0, 0.0, 0.1])
    can = CLASSES["tomato_soup_can"]
    assert isinstance(SUCTION.sample_grasps(can, steep, SAMPLING), GraspFailure)


def test_the_default_cup_is_the_widest_that_seals_on_all_objects() -> None:
    """Faces of all boxes and tops of all cans of the fourteen classes."""

    def seals(diameter: float) -> bool:
        for o in load_catalog().object_set("pantry14"):
            for axis in (
                range(3)
                if o.shape is Shape.BOX
                else [2]
                if o.only_rest is RestOrientation.UPRIGHT
                else []
            ):
                z = -np.eye(3)[axis]
                x = np.eye(3)[(axis + 1) % 3]
                R = RotationMatrix(np.column_stack([x, np.cross(z, x), z]))
                X = RigidTransform(R, -z * o.size[axis] / 2)
                if lip_flatness_deviation(o, X, diameter) > SUCTION.unevenness:
                    return False
        return True

    assert [d for d in (0.015, 0.020, 0.025, 0.030, 0.040, 0.055) if seals(d)] == [
        0.015,
        0.020,
        CUP.diameter,
    ]


def test_only_small_cups_follow_a_marker() -> None:
    """The sagitta of a marker of radius 9 mm is r - sqrt(r^2 - d^2 / 4)."""
    side = RigidTransform(ALONG_MINUS_X, [0.009, 0.0, 0.0])
    for diameter in (0.005, 0.006, 0.008, 0.010, 0.015):
        sagitta = 0.009 - math.sqrt(0.009**2 - diameter**2 / 4)
        deviation = lip_flatness_deviation(CLASSES["large_marker"], side, diameter)
        assert deviation == pytest.approx(sagitta, abs=1.5e-4)  # of a prism of 32 sides
        assert (deviation <= SUCTION.unevenness) is (diameter <= 0.008)


def test_the_cup_is_chosen_by_what_seals_and_holds() -> None:
    """A large cup cannot follow the marker; the small one cannot bear the box."""
    gripper = DEFAULT_CELL.gripper
    for name, tools in (("large_marker", {"small"}), ("cracker_box", {"large"})):
        o = resting(name)
        grasps = gripper.sample_grasps(o.object_class, rigid_transform(o.X_TO), SAMPLING)
        assert not isinstance(grasps, GraspFailure)
        assert {grasp.tool for grasp in grasps} == tools


def test_the_holding_force_is_pressure_times_area() -> None:
    assert SUCTION.holding_force("single") == pytest.approx(0.8 * 101_325 * math.pi * 0.0125**2)


def test_load_ratios_of_simple_loads() -> None:
    zero = np.zeros(3)
    assert SUCTION.load_ratio(
        "single", np.array([0.0, 0.0, SUCTION.holding_force("single")]), zero
    ) == pytest.approx(1.0)
    assert SUCTION.load_ratio(
        "single", zero, np.array([0.0, SUCTION.holding_force("single") * 0.0125 / 2, 0.0])
    ) == pytest.approx(1.0)
    assert SUCTION.load_ratio(
        "single", np.array([SUCTION.friction * SUCTION.holding_force("single"), 0.0, 0.0]), zero
    ) == pytest.approx(1.0)
    assert SUCTION.load_ratio("single", np.array([0.0, 0.0, -5.0]), zero) == 0.0, "a pressing force"
    assert SUCTION.load_ratio(
        "single", np.array([[0.0, 0, 10], [0, 0, 20]]), np.zeros((2, 3))
    ) == pytest.approx(np.array([10, 20]) / SUCTION.holding_force("single"))
    sliding = SUCTION.friction * SUCTION.holding_force("single")
    twist = sliding * 0.0125
    assert SUCTION.load_ratio("single", zero, np.array([0.0, 0.0, twist])) == pytest.approx(1.0)
    assert SUCTION.load_ratio(
        "single", np.array([0.0, 0.6 * sliding, 0.0]), np.array([0.0, 0.0, -0.8 * twist])
    ) == pytest.approx(1.0), "a shear and a twist add up as legs of a right triangle"
    half = np.array([0.3 * sliding, 0.0, SUCTION.holding_force("single") / 2])
    assert SUCTION.load_ratio("single", half, zero) == pytest.approx(0.6), "half is left"


def test_the_wrench_of_a_load_at_rest_is_its_weight() -> None:
    force, moment = payload_wrench(0.5, np.array([0.02, 0.0, 0.1]), DOWN_G, np.zeros(3))
    assert force == pytest.approx([0.0, 0.0, 0.5 * GRAVITY])
    assert moment == pytest.approx([0.0, -0.02 * 0.5 * GRAVITY, 0.0])


def test_the_largest_acceleration_decreases_with_the_lever() -> None:
    """The lever is the distance of the center of mass; a load that is too heavy gives -1."""
    low = SUCTION.max_acceleration("single", 0.4, np.array([0.0, 0.0, 0.0]), DOWN_G)
    high = SUCTION.max_acceleration("single", 0.4, np.array([0.0, 0.0, 0.15]), DOWN_G)
    assert 0 < high < low
    ratio = SUCTION.load_ratio(
        "single",
        *payload_wrench(0.4, np.array([0.0, 0.0, 0.15]), DOWN_G, np.array([high, 0.0, 0.0])),
    )
    assert 0.8 / SUCTION.safety < ratio <= 1.001 / SUCTION.safety
    assert (
        SUCTION.max_acceleration(
            "single", SUCTION.holding_force("single") / GRAVITY, np.zeros(3), DOWN_G
        )
        == -1.0
    )


def test_grasps_are_sorted_from_the_center_of_the_top() -> None:
    gripper: Gripper = DEFAULT_CELL.gripper
    box = resting("cracker_box", xy=(0.1, -0.2))
    found = gripper.sample_grasps(box.object_class, rigid_transform(box.X_TO), SAMPLING)
    assert not isinstance(found, GraspFailure)
    assert len(found) == SAMPLING.max_grasps
    assert found[0].X_TG.translation() == pytest.approx([0.1, -0.2, box.top_height])
    distances = [
        float(np.linalg.norm(grasp.X_TG.translation() - found[0].X_TG.translation()))
        for grasp in found
    ]
    assert (np.diff(distances) > -1e-9).all()
    assert found[0].payload.mass == box.object_class.mass
    # The load hangs below the lip on the axis of the cup, by whole centimeters.
    below = round(box.top_height / 2 + SAMPLING.lip_gap, 2)
    load = gripper.tools[found[0].tool].X_FG @ np.array([0.0, 0.0, below])
    assert found[0].payload.p_FCm == pytest.approx(load)
    assert found[0].payload.max_acceleration >= found[-1].payload.max_acceleration >= 0.3


def test_grasps_are_sampled_once_and_when_they_are_used() -> None:
    box = resting("cracker_box")
    found = SUCTION.sample_grasps(box.object_class, rigid_transform(box.X_TO), SAMPLING)
    assert not isinstance(found, GraspFailure)
    sampled = list[Grasp]()

    def sample() -> Iterator[Grasp]:
        for grasp in found:
            sampled.append(grasp)
            yield grasp

    grasps = LazyGrasps(sample())
    assert grasps[0] is found[0]
    assert len(sampled) == 1
    assert next(iter(grasps)) is found[0]
    assert len(sampled) == 1
    assert grasps[-1] is found[-1]
    assert list(grasps) == sampled == list(found)


def test_reasons_why_there_is_no_grasp() -> None:
    can = resting("tomato_soup_can")
    rim = SuctionGripper.model_validate({"cup_diameter": 0.08})
    found = rim.sample_grasps(can.object_class, rigid_transform(can.X_TO), SAMPLING)
    assert found == GraspFailure(GraspFailureReason.NO_SEAL, math.inf)
    weak = SUCTION.model_copy(update={"vacuum": 0.1})
    found = weak.sample_grasps(can.object_class, rigid_transform(can.X_TO), SAMPLING)
    assert found == GraspFailure(GraspFailureReason.TOO_HEAVY, can.object_class.mass)


def test_a_cup_attaches_where_the_surface_is_flat() -> None:
    can = CLASSES["tomato_soup_can"]
    assert SUCTION.can_attach("single", can, on_top(0.0505))
    assert not SUCTION.can_attach("single", can, on_top(0.0505, x=0.025))


def revolved(outline: list[tuple[float, float]]) -> trimesh.Trimesh:
    """Return a solid of revolution of an outline of radii and heights [m]."""
    return trimesh.creation.revolve(np.array(outline), sections=32)


def test_the_profile_of_a_mesh_is_that_of_the_box_of_its_size(tmp_path: Path) -> None:
    own = own_mesh_class(tmp_path, trimesh.creation.box((0.05, 0.06, 0.07)))
    assert lip_flatness_deviation(own, on_top(0.035), CUP.diameter) == pytest.approx(0.0, abs=1e-9)
    assert lip_surface_profile(own, on_top(0.045), CUP.diameter) == pytest.approx(
        np.full(24, 0.010), abs=1e-7
    )
    tilted = lip_surface_profile(own, on_top(0.035, tilt=math.radians(5)), CUP.diameter)
    assert profile_tilt(tilted, CUP.diameter) == pytest.approx(math.radians(5), rel=1e-5)
    assert lip_flatness_deviation(own, on_top(0.035, x=0.02), CUP.diameter) == math.inf


def test_convex_pieces_that_bulge_over_a_flat_lid_do_not_break_the_seal(tmp_path: Path) -> None:
    """A lid that lies below its rim is flat, though a convex piece rises 2 mm above its edge."""
    rim = [(0, 0), (0.04, 0), (0.04, 0.06), (0.038, 0.06), (0.038, 0.057), (0, 0.057)]
    own = own_mesh_class(tmp_path, revolved(rim))
    for piece in own.folder.glob("convex_*.obj"):
        piece.unlink()
    bulge = revolved([(0, 0), (0.04, 0), (0.04, 0.06), (0.01, 0.058), (0, 0.057)]).convex_hull
    bulge.apply_translation([0, 0, -0.03])
    (own.folder / "convex_000.obj").write_text(bulge.export(file_type="obj"))
    assert lip_flatness_deviation(own, on_top(0.03), CUP.diameter) == pytest.approx(0.0, abs=1e-6)
    grasps = SUCTION.sample_grasps(own, RigidTransform([0.0, 0.0, 0.03]), SAMPLING)
    assert not isinstance(grasps, GraspFailure)
    assert grasps[0].X_TG.translation() == pytest.approx(
        [0.0, 0.0, 0.06], abs=1e-6
    )  # where the cup touches
    # The lid is 3 mm below the piece: a gap of 1.9 mm more seals, one of 2.1 mm does not.
    for lip_gap, value in ((0.0019, None), (0.0021, 0.0051)):
        found = SUCTION.sample_grasps(
            own, RigidTransform([0.0, 0.0, 0.03]), replace(SAMPLING, lip_gap=lip_gap)
        )
        assert SUCTION.can_attach("single", own, on_top(0.03 + lip_gap)) is (value is None)
        if value is not None:
            assert isinstance(found, GraspFailure)
            assert found.reason is GraspFailureReason.NO_SEAL
            assert found.value == pytest.approx(value, abs=1e-6)
        else:
            assert not isinstance(found, GraspFailure)


def test_every_grasp_on_a_mesh_is_one_that_the_simulation_attaches(tmp_path: Path) -> None:
    """In a bowl the lip goes down to the floor, 30 mm below the rim."""
    bowl = [(0, 0), (0.06, 0), (0.07, 0.036), (0.066, 0.036), (0.056, 0.006), (0, 0.006)]
    own = own_mesh_class(tmp_path, revolved(bowl))
    X_TO = RigidTransform([0.1, 0.0, 0.018])
    grasps = SUCTION.sample_grasps(own, X_TO, SAMPLING)
    assert not isinstance(grasps, GraspFailure)
    for grasp in grasps:
        X_TG = grasp.X_TG @ RigidTransform([0.0, 0.0, -SAMPLING.lip_gap])
        X_OG = X_TO.InvertAndCompose(X_TG)
        assert SUCTION.can_attach("single", own, X_OG)
        assert lip_surface_profile(own, X_OG, CUP.diameter).min() <= MAX_SEAL_GAP
        assert grasp.X_TG.translation()[2] == pytest.approx(0.006, abs=0.003)


def test_a_plate_has_grasps_at_which_the_cup_seals(tmp_path: Path) -> None:
    """Its rim is 9 mm above its floor; the convex pieces stay within the reach of the lip."""
    plate = [(0, 0), (0.055, 0), (0.09, 0.009), (0.09, 0.014), (0.054, 0.005), (0, 0.005)]
    own = own_mesh_class(tmp_path, revolved(plate))
    grasps = SUCTION.sample_grasps(own, RigidTransform([0.0, 0.0, 0.007]), SAMPLING)
    assert not isinstance(grasps, GraspFailure)
    assert grasps[0].X_TG.translation()[2] == pytest.approx(0.005, abs=0.0035 + 1e-6)
