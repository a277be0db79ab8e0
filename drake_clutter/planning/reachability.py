"""Where the cup can go: poses that the arm reaches in its cell without collision, however it is folded.

Frames: T the tray, G the cup. The cell has table, tray, pedestal and camera, and no objects.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.tool_kinematics import downward_pose

Floats = NDArray[np.float64]

NUM_YAWS = 12
WALL_MARGIN = 0.05
"""m, from the tray's rim: no object's middle comes closer."""


@dataclass(frozen=True)
class ReachabilityResult:
    """How poses of the cup are reached.

    Attributes:
        num_solutions: (n,) solutions without collision.
        manipulability: (n,) m^3, the best of them; 0 where there is none.
        q: (n, joints) rad, of that one; NaN where there is none.
        blocking_bodies: what the arm would hit where it reaches a pose, but only with collision; else "".
    """

    num_solutions: NDArray[np.int64]
    manipulability: Floats
    q: Floats
    blocking_bodies: tuple[str, ...]


class ReachabilityAnalysis:
    """Of an arm in its cell."""

    def __init__(self, cell: WorkCell) -> None:
        """Makes the empty cell."""
        self._cell = cell
        self._planner = PickPlacePlanner(cell, PlannerConfig())
        self._collision_model = self._planner.collision_model(())
        self._min_distance = self._planner.config.min_distance

    def analyze_poses(self, X_TG: Floats) -> ReachabilityResult:
        """Of poses (n, 4, 4) of the cup."""
        robot = self._planner.tool.robot
        q = self._planner.tool.solve_ik(X_TG)
        worth = np.nan_to_num(robot.manipulability(q), nan=-1.0)
        count, best = np.zeros(len(q), int), np.zeros(len(q))
        best_q, in_the_way = np.full((len(q), robot.num_joints), np.nan), [""] * len(q)
        for k in range(len(q)):
            for branch in np.argsort(-worth[k]):
                if worth[k, branch] < 0:
                    break
                at = robot.unwrap(q[k, branch], robot.home)
                if hit := self._collision_model.distances_below(at, self._min_distance):
                    in_the_way[k] = in_the_way[k] or " and ".join(
                        min(hit, key=lambda c: c.distance).pair
                    )
                    continue
                if count[k] == 0:
                    best[k], best_q[k] = worth[k, branch], at
                count[k] += 1
        return ReachabilityResult(
            count,
            best,
            best_q,
            tuple("" if n else hit for n, hit in zip(count, in_the_way, strict=True)),
        )

    def compute_map(self, heights: Sequence[float], spacing: float) -> "ReachabilityMap":
        """Of a cup that points down, over the tray.

        Args:
            heights: m, of the lip over the tray's floor.
            spacing: m, of the grid.
        """
        half_size = self._cell.support.half_size
        ends = np.maximum(half_size - WALL_MARGIN, half_size / 2).tolist()
        along_x, along_y = (
            np.linspace(-end, end, max(2, round(2 * end / spacing) + 1)) for end in ends
        )
        share, best = np.zeros((2, len(heights), len(along_x), len(along_y)))
        yaws = np.arange(NUM_YAWS) * (2 * np.pi / NUM_YAWS)
        for k, height in enumerate(heights):
            for i, x in enumerate(along_x):
                for j, y in enumerate(along_y):
                    found = self.analyze_poses(
                        np.array([downward_pose(yaw, np.array([x, y, height])) for yaw in yaws])
                    )
                    share[k, i, j] = np.mean(found.num_solutions > 0)
                    best[k, i, j] = found.manipulability.max()
        return ReachabilityMap(tuple(heights), along_x, along_y, share, best)


@dataclass(frozen=True)
class ReachabilityMap:
    """Where over the tray a cup that points down can go.

    Attributes:
        heights: m. x: (n,) m, in T. y: (m,) m, in T.
        reachable_fraction: (heights, n, m) of the yaws that are reached.
        manipulability: m^3, the best at any of them. By height, x, y.
    """

    heights: tuple[float, ...]
    x: Floats
    y: Floats
    reachable_fraction: Floats
    manipulability: Floats


def score_base_positions(
    cell: WorkCell, positions: Sequence[tuple[float, float]]
) -> list[tuple[float, float]]:
    """For bases at (x, y) m, as high and turned as the config's: the mean share that is reached, and the mean manipulability.

    A base in or over the tray scores nothing.
    """
    found = []
    for x, y in positions:
        base = cell.robot.base.model_copy(
            update={"translation": (x, y, cell.robot.base.translation[2])}
        )
        moved = cell.model_copy(update={"robot": cell.robot.model_copy(update={"base": base})})
        if moved.pedestal_overlaps_support:
            found.append((0.0, 0.0))
            continue
        reached = ReachabilityAnalysis(moved).compute_map((0.05, 0.25, 0.45), 0.15)
        found.append(
            (float(reached.reachable_fraction.mean()), float(reached.manipulability.mean()))
        )
    return found
