"""The search for the ways of one move: grasps, yaws, branches and heights, until one is free.

Frames: T the tray, B the arm's base, F the flange, G the cup, O the picked object.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from pydrake.trajectories import PiecewisePolynomial, Trajectory

from drake_clutter.cell.gripper import Grasp, Payload
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.planning.clearance import Clearance, ClearanceScene
from drake_clutter.planning.paths import SPACING, least_time, sampled, slowed, smooth, timed
from drake_clutter.planning.plan import DESCENT_SPEED, NoPlan, Phase, Plan, PlanFailure
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.shorten import Wall, Way, shortened
from drake_clutter.planning.tool_kinematics import (
    CarryWay,
    ToolKinematics,
    downwards,
    inverse,
    lifted,
)
from drake_clutter.scenes.scene import Pose, SceneObject
from drake_clutter.simulation.plant import rigid_transform

Floats = NDArray[np.float64]


REPORTED = 0.03
"""m; what is further away than this counts as free."""
SLACK = 0.0005
"""m, by which the held object may come closer to what it touches at an end of its way."""
SPARE = 0.005
"""m, that an optimised way is kept further away than it must be: it is looked at in few points."""
NEAR = 0.06
"""m; what is further away is not looked at when a way is optimised."""
_DESCENT_STEP = 0.005
"""m, between the points of a guarded descent."""
LEVEL = math.radians(0.5)
"""By which the gripper's axis may leave the vertical while it carries something [rad]."""


@dataclass(frozen=True)
class End:
    """Where the object is picked up or let go.

    Attributes:
        at: (2,) m, of the cup there, seen from above.
        beside: m, how close the object, while it is held, may be there to what it touches, by name.
    """

    at: Floats
    beside: Mapping[str, float]


def _array(X_AB: RigidTransform) -> Floats:
    return np.ascontiguousarray(X_AB.GetAsMatrix4())


class Attempts:
    """The search for one move: grasps, yaws, branches and heights, until a way is free."""

    def __init__(
        self,
        cell: WorkCell,
        config: PlannerConfig,
        scene: ClearanceScene,
        objects: Sequence[SceneObject],
        picked: SceneObject,
        X_TO_place: Pose,
        tops: Sequence[float] = (),
    ) -> None:
        """Nothing is tried yet; `tops` are heights of what else there is [m]."""
        self._cell, self._config, self._scene, self._picked = cell, config, scene, picked
        self._tool, self._place = ToolKinematics(cell), X_TO_place
        self._robot = self._tool.robot
        self._X_TO = _array(rigid_transform(picked.X_TO))
        self._X_TO_place = _array(rigid_transform(X_TO_place))
        self._touching = [(link, picked.name) for link in cell.gripper.contact_links]
        self.count, self.furthest = 0, NoPlan(PlanFailure.UNREACHABLE, "the grasp")
        self._progress = -1
        placed = replace(picked, X_TO=X_TO_place)
        others = [o for o in objects if o is not picked]
        bottom = max(picked.bounds_T[0][2], placed.bounds_T[0][2])
        tops = sorted({round(top, 3) for top in (*tops, *(o.top for o in others)) if top > bottom})
        rise = self._config.rise
        self._bottoms = [bottom + rise] + [top + rise for top in tops if top > bottom]

    def fail(
        self,
        progress: int,
        reason: PlanFailure,
        about: str,
        number: float = math.nan,
    ) -> None:
        """Remembers why an attempt failed, if it came further than those before."""
        if progress > self._progress:
            self._progress, self.furthest = progress, NoPlan(reason, about, number)

    def ends(self, grasp: Grasp) -> list[tuple[Floats, Floats, float]]:
        """q (n,) at the grasp and at the place, and yaw, the quickest way first."""
        yaws = np.arange(self._config.yaws) * (2 * math.pi / self._config.yaws)
        X_pick = [lifted(downwards(yaw, grasp.p_TG), self._config.lip_gap) for yaw in yaws]
        X_place = [self._at_place(X) for X in X_pick]
        q_pick, q_place = self._tool.solve(np.array(X_pick)), self._tool.solve(np.array(X_place))
        q_place = self._robot.ik.match(q_pick, q_place)
        reached = np.isfinite(q_pick[..., 0])
        if (reached & ~np.isfinite(q_place[..., 0])).any():
            self.fail(0, PlanFailure.UNREACHABLE, "the place")
        at_pick = self._robot.unwrap(q_pick, self._robot.home)
        at_place = self._robot.unwrap(q_place, at_pick)
        home = self._robot.home
        turns = np.array([at_pick - home, at_place - at_pick, at_place - home])
        with np.errstate(invalid="ignore"):
            length = least_time(turns, self._robot).sum(axis=0)
        order = np.argsort(length, axis=None, kind="stable")  # what is not finite comes last
        solutions = self._robot.ik.num_solutions
        chosen = [divmod(int(k), solutions) for k in order[: np.isfinite(length).sum()]]
        return [(at_pick[k], at_place[k], float(yaws[k[0]])) for k in chosen]

    def _at_place(self, X_TG: Floats) -> Floats:
        return np.asarray(self._X_TO_place @ inverse(self._X_TO) @ X_TG)

    def _free(self, way: Floats, end: End, progress: int, what: str) -> Clearance | None:
        """The least clearance along a way; None, and the reason is remembered, if it is less than it must be.

        Args:
            way: (m, n) rad.
            end: to which the way is near.
            progress: see `fail`.
            what: the way is.
        """
        found, least = Clearance(math.inf), self._config.clearance
        for q in way:
            for here in self._scene.close(q, REPORTED):
                allowed = self._needed(here, end, least)
                if here.distance < allowed:
                    self.fail(
                        progress,
                        PlanFailure.IN_COLLISION,
                        f"{what}: {' and '.join(here.pair)}",
                        here.distance,
                    )
                    return None
                if (
                    allowed == least
                    and here.distance < found.distance
                    and here.pair[1] not in self._scene.arm_names
                ):
                    found = here
        return found

    def _needed(self, here: Clearance, end: End, least: float) -> float:
        """m, that two parts must be apart, at the joint angles that the scene was last asked about.

        The cup may come close to its object, and the held object to what it touches at the end of its way; but as much further
        away as they are aside of that end, at least.
        """
        if here.pair in self._touching:
            close = self._config.lip_gap / 2
        elif here.pair[0] == self._picked.name and here.pair[1] in end.beside:
            close = end.beside[here.pair[1]]
        else:
            return least
        return min(least, close + float(np.linalg.norm(self._scene.cup_position()[:2] - end.at)))

    def _poses(self, grasp: Grasp, yaw: float) -> tuple[Floats, Floats, RigidTransform]:
        """X_TG at the grasp and at the place, (4, 4) each, and X_OG."""
        X_pick = lifted(downwards(yaw, grasp.p_TG), self._config.lip_gap)
        return X_pick, self._at_place(X_pick), RigidTransform(inverse(self._X_TO) @ X_pick)

    def _pick_end(self, X_OG: RigidTransform, q: Floats) -> End | None:
        """The start of the object's way; None if the arm is in collision there."""
        self._set_up("approach", X_OG)
        at = (self._X_TO @ _array(X_OG))[:2, 3]
        if self._free(q[None], End(at, {}), 1, "at the grasp") is None:
            return None
        self._set_up("carry", X_OG)
        return End(at, self._beside(q))

    def _place_end(self, X_OG: RigidTransform, q: Floats) -> End | None:
        """The end of the object's way; None if the arm or the object is in collision there."""
        self._set_up("carry", X_OG)
        end = End((self._X_TO_place @ _array(X_OG))[:2, 3], self._beside(q))
        return None if self._free(q[None], end, 2, "at the place") is None else end

    def _beside(self, q: Floats) -> dict[str, float]:
        name = self._picked.name
        near = self._scene.close(q, self._config.clearance)
        close = [here for here in near if here.pair[0] == name]
        return {
            here.pair[1]: here.distance - SLACK
            for here in sorted(close, key=lambda here: -here.distance)
        }

    def exist(self, grasp: Grasp) -> bool:
        """Whether some yaw and branch reach both ends without collision."""
        for q_pick, q_place, yaw in self.ends(grasp):
            X_OG = self._poses(grasp, yaw)[2]
            if self._pick_end(X_OG, q_pick) and self._place_end(X_OG, q_place):
                return True
        return False

    def carry_out(self, grasp: Grasp, q_pick: Floats, q_place: Floats, yaw: float) -> Plan | None:
        """A plan with this grasp, yaw and branch, at the least height that is free; None if there is none."""
        self.count += 1
        X_pick, X_place, X_OG = self._poses(grasp, yaw)
        pick, place = self._pick_end(X_OG, q_pick), None
        if pick is None:
            return None
        chosen = self._robot.vertical_tool_rows is not None  # else the way decides how it arrives
        if chosen and (place := self._place_end(X_OG, q_place)) is None:
            return None
        hangs = X_pick[2, 3] - self._picked.bounds_T[0][2]
        for bottom in self._bottoms:
            self.count += 1
            way = self._tool.carry(X_pick, X_place, bottom + hangs, q_pick, q_place)
            if isinstance(way, str):
                self.fail(3, PlanFailure.UNREACHABLE, way, bottom + hangs)
                return None
            if not chosen and (place := self._place_end(X_OG, way.down[0])) is None:
                continue
            assert place is not None
            phases = self._phases(grasp, X_OG, way, (pick, place))
            if phases is not None:
                return self._planned(X_OG, phases, way.down[0])
        return None

    def _planned(self, X_OG: RigidTransform, phases: tuple[Phase, ...], q_place: Floats) -> Plan:
        x, y, z = (float(v) for v in inverse(X_OG.GetAsMatrix4())[:3, 3])
        return Plan(
            self._picked.name,
            self._picked.X_TO,
            self._place,
            X_OG,
            self._picked.object_class.mass,
            (x, y, z),
            phases,
            self.count,
            0.0,
            self._descent(X_OG, q_place),
        )

    def _descent(self, X_OG: RigidTransform, q_place: Floats) -> Trajectory | None:
        """Straight down from the place as far as it is asked for, and the arm is free; what it holds may touch anything."""
        X_place, way = self._X_TO_place @ _array(X_OG), [q_place]
        heights = np.arange(0.0, self._config.descent + 1e-9, _DESCENT_STEP)
        self._set_up("retreat", X_OG)
        self._scene.put_one(self._picked.name, self._place.moved((0.0, 0.0, -10.0)))
        for before, height in pairwise(heights):
            X = np.array([lifted(X_place, -before), lifted(X_place, -height)])
            step = self._tool.track(X, way[-1])
            end = End(X_place[:2, 3], {})
            if step is None or self._free(step[1:], end, 0, "the descent") is None:
                break
            way.append(step[1])
        if len(way) == 1:
            return None
        return PiecewisePolynomial.FirstOrderHold(
            heights[: len(way)] / DESCENT_SPEED, np.array(way).T
        )

    def _phases(
        self,
        grasp: Grasp,
        X_OG: RigidTransform,
        way: CarryWay,
        ends: tuple[End, End],
    ) -> tuple[Phase, ...] | None:
        empty, up, down = Payload(), way.up, way.down
        to_grasp, to_home = (self._tool.homewards(column[-1]) for column in (up, down))
        ways = {
            "carry": ([way.whole], grasp.payload),
            "approach": ([np.vstack([up, home[1:]])[::-1] for home in to_grasp], empty),
            "retreat": ([np.vstack([down, home[1:]]) for home in to_home], empty),
        }
        found = {}
        for progress, (name, (choices, payload)) in enumerate(ways.items(), start=4):
            made = (self._phase(name, choice, payload, X_OG, ends, progress) for choice in choices)
            phase = next((phase for phase in made if phase), None)
            if phase is None:
                return None
            found[name] = phase
        if self._config.optimise:
            found = {
                name: self._shortened(found[name], payload, X_OG, ends)
                for name, (_, payload) in ways.items()
            }
        return found["approach"], found["carry"], found["retreat"]

    def _phase(
        self,
        name: str,
        way: Floats,
        payload: Payload,
        X_OG: RigidTransform,
        ends: tuple[End, End],
        progress: int,
    ) -> Phase | None:
        """A phase along a way; None if that is not free, or too much for the arm."""
        path = smooth(way)
        clearance = self._checked(name, path, X_OG, ends, progress)
        if clearance is None:
            return None
        trajectory = timed(path, self._cell, payload)
        if trajectory is None:
            self.fail(progress, PlanFailure.TRAJECTORY_INFEASIBLE, name)
            return None
        return Phase(name, trajectory, clearance, trajectory.end_time())

    def _set_up(self, phase: str, X_OG: RigidTransform) -> None:
        """The scene as it is during a phase."""
        name = self._picked.name
        self._scene.release()
        self._scene.put_one(name, self._place if phase == "retreat" else self._picked.X_TO)
        if phase == "carry":
            self._scene.hold(name, X_OG)

    def _checked(
        self,
        phase: str,
        path: Trajectory,
        X_OG: RigidTransform,
        ends: tuple[End, End],
        progress: int,
        spacing: float = SPACING / 2,
    ) -> Clearance | None:
        """The least clearance along a path, looked at every so many radians; None if it is too little."""
        self._set_up(phase, X_OG)
        points = sampled(path, spacing)
        if phase == "carry" and self._tilted(points, progress):
            return None
        if phase != "carry":
            return self._free(points, End(ends[int(phase == "retreat")].at, {}), progress, phase)
        half = len(points) // 2  # what it touched at the start it has left by then
        found = [self._free(points[:half], ends[0], progress, phase)]
        if found[0] is not None:
            found.append(self._free(points[half:], ends[1], progress, phase))
        return None if None in found else min((c for c in found if c), key=lambda c: c.distance)

    def _tilted(self, points: Floats, progress: int) -> bool:
        """Whether the gripper leaves the vertical at points (m, n); never with linear rows."""
        if self._robot.vertical_tool_rows is not None:
            return False
        tilt = float(np.linalg.norm(self._tool.axis(points)[:, :2], axis=1).max())
        if tilt > LEVEL:
            self.fail(progress, PlanFailure.TRAJECTORY_INFEASIBLE, "carry", tilt)
        return tilt > LEVEL

    def _shortened(
        self, phase: Phase, payload: Payload, X_OG: RigidTransform, ends: tuple[End, End]
    ) -> Phase:
        """The phase along a quicker way; as it is if none is found."""
        self._set_up(phase.name, X_OG)
        least, carried = self._config.clearance + SPARE, phase.name == "carry"
        away = End(ends[int(phase.name == "retreat")].at, {})

        def walls(q: Floats, along: float) -> list[Wall]:
            found = []
            for here, gradient in self._scene.gradients(q, NEAR):
                needed = self._needed(here, ends[int(along >= 0.5)] if carried else away, least)
                if (
                    np.abs(gradient).max() > 1e-6
                ):  # some of the wrist's parts are always as far apart
                    found.append(Wall(gradient, here.distance - needed))
            return found

        upright = phase.name != "approach", phase.name != "retreat"  # at home it may go any way
        acceleration, jacobian = payload.along_axis, self._scene.cup_jacobian
        ends_of = phase.trajectory, self._robot, upright, carried
        quick = shortened(Way(*ends_of, acceleration, walls, jacobian, self._tool.axis))
        trajectory = slowed(quick, self._cell, payload) if quick else None
        if trajectory is None or trajectory.end_time() >= phase.sure:
            return phase
        # It goes round edges as near as it may: looked at more closely than a way that rises over everything.
        clearance = self._checked(phase.name, trajectory, X_OG, ends, 0, SPACING / 4)
        if clearance is None:
            return phase
        return Phase(phase.name, trajectory, clearance, phase.sure)
