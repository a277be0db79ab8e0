"""The inverse reachability map, and the clearances that it checks at exact poses."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import DEFAULT_CELL, cell_with, resting, rng, scene_of
from numpy.typing import NDArray

from drake_clutter.cell.work_cell import load_cell
from drake_clutter.feasibility import inverse_reachability
from drake_clutter.feasibility.arm_clearance import (
    ArmGeometry,
    ObstacleTops,
    collides_with_itself,
    collides_with_objects,
    place_capsules,
)
from drake_clutter.feasibility.inverse_reachability import (
    InverseReachabilityMap,
    _dilate,
    build_inverse_reachability,
    load_inverse_reachability,
    save_inverse_reachability,
)
from drake_clutter.feasibility.move_poses import MovePoses, find_move_poses
from drake_clutter.feasibility.reachability_query import SPACING
from drake_clutter.files import InputError
from drake_clutter.grammar.orientation import Orientation
from drake_clutter.planning.collision_model import CollisionModel
from drake_clutter.planning.pick_place_plan import PickPlacePlan, PlanningFailure
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.tool_kinematics import ToolKinematics, downward_pose
from drake_clutter.resources import resource_path
from drake_clutter.robots.serial_chain import chain_frames
from drake_clutter.scenes.scene import Pose

Floats = NDArray[np.float64]

NO_TOPS = ObstacleTops.from_scene(scene_of(), np.empty(0))


def disk_map(
    radius: float,
    *,
    lowest: float = 0.1,
    turn: float = 0.0,
    turn_limits: tuple[float, float] = (-2 * math.pi, 2 * math.pi),
) -> InverseReachabilityMap:
    """Return a map in which one solution reaches a disk around the base, at z from 0 to 1 m."""
    radii = np.arange(0.0, 1.0, SPACING)
    shape = len(radii), 51, 24
    solutions = np.zeros(shape, np.uint8)
    solutions[radii <= radius] = 1 << 3
    heights = np.full((*shape, 8), lowest, np.float32)
    turns = np.full((*shape, 8), turn, np.float32)
    return InverseReachabilityMap(
        np.arange(51) * np.float64(SPACING),
        solutions,
        heights,
        turns,
        np.array(turn_limits),
        ArmGeometry.without_closed_form(),
    )


def move_rows(p_pick: Sequence[float], p_place: Sequence[float], top: float) -> MovePoses:
    ends = [downward_pose(0.3, np.array(p)) for p in (p_pick, p_place)]
    return MovePoses(
        np.array([ends]), np.full((1, 2), 0.3), np.array([top]), np.array([0, 1]), np.array([0])
    )


def reaches(
    found: InverseReachabilityMap,
    moves: MovePoses,
    bases: Sequence[Sequence[float]],
    table: float,
    tops: ObstacleTops = NO_TOPS,
) -> list[bool]:
    """Return whether the first move is reachable from each base."""
    result: list[bool] = found.find_reachable(moves, np.array(bases), table, tops)[:, 0].tolist()
    return result


def test_inverse_reachability_of_a_disk() -> None:
    """A base reaches a move if pick, place and the points above them are in its disk."""
    moves = move_rows((0.3, 0.0, 0.1), (0.3, 0.4, 0.2), 0.4)
    bases = [[0.0, 0.2, 0.0], [-0.2, 0.2, 0.0], [0.3, 0.2, 0.15], [0.3, 0.2, -0.7]]
    # 0.36 m to both; 0.54 m to both; the pick is below the map; the way is above it.
    found = reaches(disk_map(0.45), moves, [[*base, 0.0] for base in bases], -1.0)
    assert found == [True, False, False, False]


def test_inverse_reachability_keeps_links_above_the_table() -> None:
    moves = move_rows((0.3, 0.0, 0.1), (0.3, 0.1, 0.2), 0.4)
    base = [[0.0, 0.0, 0.0, 0.0]]
    assert reaches(disk_map(0.45, lowest=0.1), moves, base, 0.05) == [True]
    assert reaches(disk_map(0.45, lowest=0.1), moves, base, 0.096) == [False]


def test_the_first_joint_keeps_its_limits() -> None:
    """It turns by 0.2 rad plus the direction of the tool as the base sees it, in full turns."""
    moves = move_rows((-0.3, -0.01, 0.1), (-0.3, 0.01, 0.2), 0.4)  # around the direction -x
    found = disk_map(0.45, turn=0.2, turn_limits=(math.radians(-170), math.radians(170)))
    yaws = np.radians([0.0, 60.0, 175.0, 190.0, 210.0])
    # The joint is at 180 + 11.5 deg minus the yaw, give or take 1.9 deg, and 191.5 is -168.5 deg.
    expected = [False, True, True, True, True]
    assert reaches(found, moves, [[0.0, 0.0, 0.0, yaw] for yaw in yaws], -1.0) == expected
    narrow = disk_map(0.45, turn=0.2, turn_limits=(0.0, math.radians(120)))
    expected = [False, False, True, False, False]
    assert reaches(narrow, moves, [[0.0, 0.0, 0.0, yaw] for yaw in yaws], -1.0) == expected


def test_move_poses_follow_the_object() -> None:
    """The place poses of the tool differ from the grasp by the move of the object."""
    planner = PickPlacePlanner(DEFAULT_CELL, PlannerConfig())
    can = resting("tomato_soup_can", xy=(-0.1, -0.2))
    grasps = planner.grasps(can)
    assert not isinstance(grasps, PlanningFailure)
    place = Pose((0.2, 0.1, can.X_TO.p[2] + 0.05), can.X_TO.quaternion)
    moves = find_move_poses(can, 0, place, [grasps[0]], planner.config)
    picks, places = moves.ends.swapaxes(0, 1)
    assert (places - picks)[:, :3, 3] == pytest.approx(np.tile([0.3, 0.3, 0.05], (12, 1)))
    assert (places - picks)[:, :3, :3] == pytest.approx(np.zeros((12, 3, 3)))
    assert moves.heights - places[:, 2, 3] == pytest.approx(
        planner.config.lift_height * np.ones(12)
    )
    yaws = np.sort(moves.yaws[:, 0] % (2 * math.pi))
    assert np.diff(yaws) == pytest.approx(np.full(11, math.pi / 6))
    X = downward_pose(float(moves.yaws[3, 0]), picks[3, :3, 3])
    assert picks[3] == pytest.approx(X)
    joined = MovePoses.join([moves, replace(moves, picked=np.array([2]))])
    assert (joined.starts.tolist(), joined.picked.tolist()) == ([0, 12, 24], [0, 2])


def test_move_poses_on_a_side() -> None:
    """The tool is horizontal, at four yaws."""
    planner = PickPlacePlanner(DEFAULT_CELL, PlannerConfig())
    box = resting("pudding_box")
    grasps = planner.grasps(box, (-1.0, 0.0, 0.0))
    assert not isinstance(grasps, PlanningFailure)
    moves = find_move_poses(box, 0, box.X_TO, grasps, planner.config)
    assert np.isnan(moves.yaws).all()
    axes = moves.ends[:, 0, :3, 2]
    assert axes == pytest.approx(np.tile([1.0, 0.0, 0.0], (len(axes), 1)), abs=1e-6)
    assert len(axes) == 4 * len(grasps)
    turned = moves.ends[:4, 0, :3, 0]
    assert turned @ turned[0] == pytest.approx([1.0, 0.0, -1.0, 0.0], abs=1e-9)


class Arm:
    """The default cell's arm with its geometry, alone."""

    def __init__(self, *settings: str) -> None:
        self.cell = cell_with(*settings)
        self.name, tool = next(iter(self.cell.gripper.tools.items()))
        self.tool = ToolKinematics(self.cell, self.name)
        self.model = CollisionModel(self.cell, ())
        shapes = self.model.moving_capsules().shapes.tolist()
        pairs = [(a, b) for k, a in enumerate(shapes) for b in shapes[:k]]
        self.geometry = ArmGeometry.from_model(self.tool, tool, self.model, pairs)

    def placed(self, q: Floats) -> Floats:
        """Return the ends of the capsules in the base. Shape (c, 2, 3)."""
        arm = self.geometry
        n = len(q)
        placed = np.empty((len(arm.radii), 2, 3))
        frames, moved = np.empty((n + 1, 4, 4)), np.empty((n, 3, 4))
        place_capsules(arm.fixed, np.ones(n, bool), arm.depths, arm.ends, q, frames, moved, placed)
        return placed


def full_map(arm: ArmGeometry) -> InverseReachabilityMap:
    """Return a map by which every branch of an arm comes into question within 2 m."""
    shape = 100, 200, 24
    none = np.zeros((*shape, 8), np.float32)
    every = np.full(shape, 255, np.uint8)
    return InverseReachabilityMap(
        np.arange(200) * np.float64(SPACING) - 2, every, none, none, np.zeros(2), arm
    )


def test_exact_poses_agree_with_the_planner() -> None:
    """A tool that points down and one on a side reach a box where the planner does."""
    arm = Arm()
    q = rng(1).uniform(-math.pi, math.pi, (400, 6))
    pairs = {(a, b) for a, b in arm.model.distances_along(q, 0.005).pairs.tolist()}
    tool = arm.cell.gripper.tools[arm.name]
    tools = full_map(ArmGeometry.from_model(arm.tool, tool, arm.model, pairs))
    planner = PickPlacePlanner(arm.cell, PlannerConfig(optimize=False))
    box = resting("pudding_box", Orientation.UPRIGHT_0, (0.15, 0.1))
    scene = scene_of(box)
    tops = ObstacleTops.from_scene(scene, arm.geometry.radii + planner.config.min_distance)
    place = Pose((0.15, -0.05, float(box.X_TO.p[2])), box.X_TO.quaternion)
    base = (*arm.cell.robot.base.translation, 0.0)
    far = (-1.8, 0.0, 0.0, 0.0)
    for normal in ((0.0, 0.0, 1.0), (-1.0, 0.0, 0.0)):
        grasps = planner.grasps(box, normal)
        assert not isinstance(grasps, PlanningFailure)
        of_tool = [grasp for grasp in grasps if grasp.tool == arm.name]
        assert isinstance(planner.plan([box], box.name, place, grasp=of_tool), PickPlacePlan)
        moves = find_move_poses(box, 0, place, of_tool, planner.config)
        table = arm.cell.table_height
        assert reaches(tools, moves, [base, far], table, tops) == [True, False]
        turned = [[*base[:3], 1.0]]
        assert reaches(tools, moves, turned, table, tops) == [True], "the first joint turns back"
        assert reaches(tools, moves, [base], 0.2, tops) == [False], "the grasp is below the table"


def test_the_tool_tells_where_the_last_joint_is() -> None:
    arm = Arm()
    q = rng(4).uniform(-math.pi, math.pi, 6)
    fixed = arm.geometry.fixed
    frames, moved = np.empty((7, 4, 4)), np.empty((6, 3, 4))
    chain_frames(fixed, np.ones(6, bool), q, frames, moved)
    X_TJ = arm.tool.pose(q) @ arm.geometry.X_GJ
    X_TB = arm.cell.robot.X_TB.GetAsMatrix4()
    assert np.linalg.inv(X_TB) @ X_TJ == pytest.approx(np.vstack([moved[5], [0, 0, 0, 1]]))
    assert ArmGeometry.without_closed_form().X_GJ.shape == (0, 4)


def test_rows_are_tried_in_any_order() -> None:
    """A base that only the last of three grasps serves comes between others."""
    moves = [move_rows((x, 0.0, 0.1), (x, 0.1, 0.2), 0.4) for x in (3.0, 0.3, 6.0)]
    joined = MovePoses.join(moves)
    one = replace(joined, starts=np.array([0, 3, 3]), picked=np.array([0, 0]))
    bases = np.array([[x, 0.0, 0.0, 0.0] for x in (0.0, 6.0, 3.0, -1.0, 6.0, 0.0)])
    found = disk_map(0.45).find_reachable(one, bases, -1.0, NO_TOPS)
    assert found[:, 0].tolist() == [True, True, True, False, True, True]
    assert not found[:, 1].any(), "a move without grasps"


def test_the_map_agrees_with_inverse_kinematics(monkeypatch: pytest.MonkeyPatch) -> None:
    """A base reaches a move where one branch solves all points; random bases, real map.

    The bounds differ where a link is within 1 cm of what it must not touch.
    """
    monkeypatch.setattr(inverse_reachability, "NUM_YAWS", 6)
    cell = load_cell(resource_path("models/cells/ur3e_epick_tray.yaml"))
    name = next(iter(cell.gripper.tools))
    reachability = build_inverse_reachability(cell, name)
    far = cell.robot.base.model_copy(update={"translation": (-50.0, 0.0, 2.0)})
    apart = cell.model_copy(
        update={"robot": cell.robot.model_copy(update={"base": far}), "fixtures": ()}
    )
    tool, model = ToolKinematics(apart, name), CollisionModel(apart, ())
    X_TB_apart = apart.robot.X_TB.GetAsMatrix4()
    down = move_rows((0.0, 0.0, 0.1), (0.1, 0.15, 0.2), 0.3)
    to_x = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    ends = down.ends.copy()
    ends[..., :3, :3] = to_x
    side = replace(down, ends=ends, yaws=np.full((1, 2), math.nan))
    tops = ObstacleTops.from_scene(scene_of(), reachability.arm.radii)
    none = np.full_like(tops.first, -math.inf)
    nothing = replace(tops, first=none, second=none, highest=none.max(axis=(1, 2)))
    num_reached, num_sure = 0, 0
    bases = rng(5).uniform((-0.5, -0.3, 0.0, -math.pi), (0.3, 0.5, 0.6, math.pi), (40, 4))
    for moves in (down, side):
        floor = 0.0 if moves is side else -2.0
        above = moves.ends[0].copy()
        above[:, 2, 3] = moves.heights[0]
        points = np.array([moves.ends[0, 0], above[0], above[1], moves.ends[0, 1]])
        found = reaches(reachability, moves, bases.tolist(), -2.0, nothing)
        for base, is_found in zip(bases, found, strict=True):
            X_TB = downward_pose(base[3], base[:3])
            X_TB[:3, 1:3] *= -1  # upright
            q = tool.solve_ik(X_TB_apart @ np.linalg.inv(X_TB) @ points).swapaxes(0, 1)
            q = q[np.isfinite(q).all(axis=(1, 2))]
            change = (q[:, 2] - q[:, 1] + math.pi) % (2 * math.pi) - math.pi
            q = np.concatenate([q, (q[:, 1] + change / 2)[:, None]], axis=1)
            height = 2.0 - base[2]
            clear = [
                not len(model.distances_along(branch, 0.015).rows)
                and model.lowest_points(branch).min() - height > floor + 0.015
                for branch in q
            ]
            assert any(clear) <= is_found <= bool(len(q)), base
            num_reached += is_found
            num_sure += any(clear) == bool(len(q))

    assert 15 < num_reached < 60
    assert num_sure > 60


def test_dilated_maps_have_the_bits_of_neighbors() -> None:
    bits = np.zeros((4, 3, 24), np.uint8)
    bits[0, 1, 0] = 4
    dilated = _dilate(bits)
    assert {tuple(index) for index in np.argwhere(dilated == 4).tolist()} == {
        (i, j, k) for i in (0, 1) for j in (0, 1, 2) for k in (23, 0, 1)
    }


def test_capsules_are_where_the_collision_model_has_them() -> None:
    """Pairs of round links are as close as in the collision model; cylinders are shortened."""
    arm = Arm()
    links = {"forearm", "wrist_1", "wrist_2", "wrist_3", "upper_arm", "shoulder"}
    capsules = arm.model.moving_capsules()
    names = [arm.model.owner_name(shape) for shape in capsules.shapes.tolist()]
    generator = rng(3)
    num_close = 0
    for _ in range(60):
        q = generator.uniform(-math.pi, math.pi, 6)
        placed = arm.placed(q)
        found = arm.model.distances_along(q[None], 0.1)
        of_links = [
            (pair, distance)
            for pair, distance in zip(found.pairs.tolist(), found.distances.tolist(), strict=True)
            if {arm.model.owner_name(shape) for shape in pair} <= links
        ]
        for pair, distance in of_links:
            index = [capsules.shapes.tolist().index(shape) for shape in pair]
            pairs = np.array([index])
            radii = arm.geometry.radii
            assert collides_with_itself(placed, radii, pairs, distance + 1e-6), names
            assert not collides_with_itself(placed, radii, pairs, distance - 1e-6), names
            num_close += 1
    assert num_close > 50


def test_heights_above_a_box() -> None:
    """A ball of 5 cm rests on the box's top, or 3 cm beside it on its edge."""
    box = resting("sugar_box")
    (low_x, low_y, _), (high_x, high_y, top) = box.bounds_T
    scene = scene_of(box, resting("tomato_soup_can", xy=(0.25, 0.25)))
    tops = ObstacleTops.from_scene(scene, np.array([0.05]))

    def heights(x: float, y: float) -> tuple[float, int, float]:
        i, j = np.round((np.array([x, y]) - tops.corner) / 0.005).astype(int)
        return tops.first[0, i, j], tops.owners[0, i, j], tops.second[0, i, j]

    middle = (low_x + high_x) / 2, (low_y + high_y) / 2
    assert heights(*middle)[0] == pytest.approx(top + 0.05)
    assert heights(*middle)[1:] == (0, -math.inf)
    beside = heights(high_x + 0.03, middle[1])[0]
    # The grid point is up to 2.5 mm from the position.
    assert math.sqrt(0.05**2 - 0.0325**2) <= beside - top <= math.sqrt(0.05**2 - 0.0275**2)
    assert heights(high_x + 0.06, middle[1]) == (-math.inf, -1, -math.inf)
    assert heights(0.25, 0.25)[1] == 1
    wall = scene.support.wall_height
    assert heights(0.0, 0.35)[0] == pytest.approx(wall + 0.05, abs=1e-4)


def test_a_capsule_over_a_box() -> None:
    """Only the object that a tool picks may be touched, and only by the tool."""
    box = resting("sugar_box")
    radii = np.array([0.03])
    tops = ObstacleTops.from_scene(scene_of(box), radii)
    center = np.array([*(box.bounds_T[0][:2] + box.bounds_T[1][:2]) / 2, box.top_height])

    def collides(height: float, *, may_touch: bool, picked: int, yaw: float = 0.0) -> bool:
        """Return whether a level capsule does, of which one end is over the box."""
        end = center + np.array([0.0, 0.0, height - 0.4])
        placed = np.array([[end, end + np.array([0.3, 0.0, 0.0])]])
        c, s = math.cos(yaw), math.sin(yaw)
        placed[..., :2] = placed[..., :2] @ np.array([[c, -s], [s, c]])  # in the turned base
        base = np.array([0.0, 0.0, 0.4, yaw])
        arrays = tuple(vars(tops).values())
        return bool(
            collides_with_objects(placed, radii, base, arrays, np.array([may_touch]), picked)
        )

    for yaw in (0.0, 1.0):
        assert collides(0.029, may_touch=False, picked=0, yaw=yaw)
        assert not collides(0.031, may_touch=False, picked=0, yaw=yaw)
    assert collides(0.0, may_touch=True, picked=1)
    assert not collides(0.0, may_touch=True, picked=0)


def test_maps_are_read_back(tmp_path: Path) -> None:
    arm = Arm()
    written = disk_map(0.3, turn=0.5)
    written = InverseReachabilityMap(**{**vars(written), "arm": arm.geometry})
    path = tmp_path / "map.npz"
    save_inverse_reachability(path, written)
    read = load_inverse_reachability(path)
    for name in ("heights", "solutions", "lowest", "turns", "turn_limits"):
        assert np.array_equal(getattr(read, name), getattr(written, name))
    for name, values in vars(arm.geometry).items():
        assert np.array_equal(getattr(read.arm, name), values)
    np.savez(path, heights=written.heights)
    with pytest.raises(InputError, match=r"map\.npz: .*expected an inverse reachability map"):
        load_inverse_reachability(path)
