"""The search for the ways of one move: grasps, yaws, branches and heights, until one is free.

Frames: T the tray, B the arm's base, F the flange, G the cup, O the picked object.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydrake.trajectories import PiecewisePolynomial, Trajectory

from drake_clutter.cell.kinematics import forward_kinematics
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.planning.clearance import Clearance, ClearanceScene
from drake_clutter.planning.paths import SPACING, Payload, least_time, nearest_turns, sampled, slowed, smooth, straight, timed
from drake_clutter.planning.plan import DESCENT_SPEED, NoPlan, Phase, Plan, PlanFailure
from drake_clutter.planning.shorten import Wall, Way, shortened
from drake_clutter.scenes.scene import Pose, SceneObject
from drake_clutter.validation import Between, Flag, NonNegative, config_class

Floats = NDArray[np.float64]


@config_class
class PlannerConfig:
    """How plans are searched.

    Attributes:
        clearance: m, kept from everything, but for what the held object is closer to at an end of its way.
        rise: m, that the held object is lifted over what it must pass.
        lip_gap: m, between lip and face when the vacuum is switched on.
        grasp_spacing: m, between the points of a face that are tried; grasps: of them, at most.
        yaws: of the cup, that are tried.
        attempts: of grasp, yaw, branch and height, at most.
        least_acceleration: m/s^2, that a grasp must bear.
        time_limit: s; so long that it decides nothing: the same question has the same answer on any machine.
        descent: m, at most, that an object is lowered from its place until it touches something; 0: it is let go there.
        above: m, over its place, that this descent begins; where there is no room to go down, it is let go at its place.
        optimise: whether the sure way is made quicker by trajectory optimisation, see `planning/shorten.py`.
    """

    clearance: NonNegative = 0.005
    rise: NonNegative = 0.020
    lip_gap: NonNegative = 0.0005
    grasp_spacing: NonNegative = 0.012
    grasps: Annotated[int, Between(0)] = 9
    yaws: Annotated[int, Between(0)] = 12
    attempts: Annotated[int, Between(0)] = 400
    least_acceleration: NonNegative = 0.3
    time_limit: NonNegative = 600.0
    descent: NonNegative = 0.0
    above: NonNegative = 0.0
    optimise: Flag = True


REPORTED = 0.03
"""m; what is further away than this counts as free."""
SLACK = 0.0005
"""m, by which the held object may come closer to what it touches at an end of its way."""
SPARE = 0.005
"""m, that an optimised way is kept further away than it must be: it is looked at in few points."""
NEAR = 0.06
"""m; what is further away is not looked at when a way is optimised."""
_VERTICAL_STEP = 0.02
"""m, between the points of a vertical way."""
_DESCENT_STEP = 0.005
"""m, between the points of a guarded descent."""
_JUMP = 0.5
"""rad, from one point of a vertical way to the next: the branch goes on elsewhere."""


def matrix(pose: Pose) -> Floats:
    """(4, 4) of a pose."""
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = pose.rotation, pose.p
    return X


def inverse(X_AB: Floats) -> Floats:
    """(4, 4) X_BA."""
    X = np.eye(4)
    X[:3, :3] = X_AB[:3, :3].T
    X[:3, 3] = -X_AB[:3, :3].T @ X_AB[:3, 3]
    return X


def downwards(yaw: float, p_TG: Floats) -> Floats:
    """(4, 4) X_TG of a cup that points down."""
    c, s = math.cos(yaw), math.sin(yaw)
    X = np.eye(4)
    X[:3, :3] = np.array([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]])
    X[:3, 3] = p_TG
    return X


@dataclass(frozen=True)
class Grasp:
    """Where the cup goes.

    Attributes:
        p_TG: (3,) m, on the top face.
        payload: what the cup then carries.
    """

    p_TG: Floats
    payload: Payload


@dataclass(frozen=True)
class End:
    """Where the object is picked up or let go.

    Attributes:
        at: (2,) m, of the cup there, seen from above.
        beside: m, how close the object, while it is held, may be there to what it touches, by name.
    """

    at: Floats
    beside: Mapping[str, float]


class Attempts:
    """The search for one move: grasps, yaws, branches and heights, until a way is free."""

    def __init__(
        self,
        cell: WorkCell,
        config: PlannerConfig,
        reach: Callable[[Floats], Floats],
        scene: ClearanceScene,
        objects: Sequence[SceneObject],
        picked: SceneObject,
        X_TO_place: Pose,
        tops: Sequence[float] = (),
    ) -> None:
        """Nothing tried yet; `reach` gives the branches for poses X_TG (..., 4, 4), `tops` are of what else there is, m."""
        self._cell, self._config, self._reach, self._scene, self._picked = cell, config, reach, scene, picked
        self._X_TO, self._X_TO_place, self._place = matrix(picked.X_TO), matrix(X_TO_place), X_TO_place
        self.count, self.furthest = 0, NoPlan(PlanFailure.UNREACHABLE, "the grasp")
        self._progress = -1
        placed = replace(picked, X_TO=X_TO_place)
        others = [o for o in objects if o is not picked]
        bottom = max(picked.bounds_T[0][2], placed.bounds_T[0][2])
        tops = sorted({round(top, 3) for top in (*tops, *(o.top for o in others)) if top > bottom})
        self._bottoms = [bottom + self._config.rise] + [top + self._config.rise for top in tops if top > bottom]
        self._home = np.array(cell.robot.home)

    def fail(self, progress: int, reason: PlanFailure, about: str, number: float = math.nan) -> None:
        """Remembers why an attempt failed, if it came further than those before."""
        if progress > self._progress:
            self._progress, self.furthest = progress, NoPlan(reason, about, number)

    def ends(self, grasp: Grasp) -> list[tuple[Floats, Floats, int, float]]:
        """q at the grasp and at the place, branch and yaw, the quickest way first."""
        yaws = np.arange(self._config.yaws) * (2 * math.pi / self._config.yaws)
        X_pick = np.array([self._lifted(downwards(yaw, grasp.p_TG), self._config.lip_gap) for yaw in yaws])
        X_place = np.array([self._at_place(X) for X in X_pick])
        q_pick, q_place = self._reach(X_pick), self._reach(X_place)
        reached = np.isfinite(q_pick[..., 0])
        if (reached & ~np.isfinite(q_place[..., 0])).any():
            self.fail(0, PlanFailure.UNREACHABLE, "the place")
        at_pick = nearest_turns(q_pick, self._home)
        at_place = nearest_turns(q_place, at_pick)
        turns = np.array([at_pick - self._home, at_place - at_pick, at_place - self._home])
        with np.errstate(invalid="ignore"):
            length = least_time(turns).sum(axis=0)
        order = np.argsort(length, axis=None, kind="stable")  # what is not finite comes last
        chosen = [divmod(int(n), 8) for n in order[: np.isfinite(length).sum()]]
        return [(at_pick[k, branch], at_place[k, branch], branch, float(yaws[k])) for k, branch in chosen]

    @staticmethod
    def _lifted(X_TG: Floats, height: float) -> Floats:
        X = X_TG.copy()
        X[2, 3] += height
        return X

    def _at_place(self, X_TG: Floats) -> Floats:
        return np.asarray(self._X_TO_place @ inverse(self._X_TO) @ X_TG)

    def _column(self, X_TG: Floats, top: float, branch: int, start: Floats) -> Floats | None:
        """(n, 6) straight up from a pose until the cup is at a height; None if it is out of reach, or the branch jumps."""
        heights = np.linspace(X_TG[2, 3], top, max(2, math.ceil((top - X_TG[2, 3]) / _VERTICAL_STEP) + 1))
        X = np.broadcast_to(X_TG, (len(heights), 4, 4)).copy()
        X[:, 2, 3] = heights
        q = self._reach(X)[:, branch]
        if not np.isfinite(q).all():
            return None
        q[0] = start
        for k in range(1, len(q)):
            q[k] = nearest_turns(q[k], q[k - 1])
        return None if np.abs(np.diff(q, axis=0)).max() > _JUMP else q

    def _free(self, way: Floats, end: End, progress: int, what: str) -> Clearance | None:
        """The least clearance along a way; None, and the reason is remembered, if it is less than it must be.

        Args:
            way: (n, 6) rad.
            end: to which the way is near.
            progress: see `fail`.
            what: the way is.
        """
        found, least = Clearance(math.inf), self._config.clearance
        for q in way:
            for here in self._scene.close(q, REPORTED):
                allowed = self._needed(here, end, least)
                if here.distance < allowed:
                    self.fail(progress, PlanFailure.IN_COLLISION, f"{what}: {' and '.join(here.pair)}", here.distance)
                    return None
                if allowed == least and here.distance < found.distance and here.pair[1] not in self._scene.arm_names:
                    found = here
        return found

    def _needed(self, here: Clearance, end: End, least: float) -> float:
        """m, that two parts must be apart, at the joint angles that the scene was last asked about.

        The cup may come close to its object, and the held object to what it touches at the end of its way; but as much further
        away as they are aside of that end, at least.
        """
        if here.pair == ("cup", self._picked.name):
            close = self._config.lip_gap / 2
        elif here.pair[0] == self._picked.name and here.pair[1] in end.beside:
            close = end.beside[here.pair[1]]
        else:
            return least
        return min(least, close + float(np.linalg.norm(self._scene.cup_position()[:2] - end.at)))

    def _poses(self, grasp: Grasp, yaw: float) -> tuple[Floats, Floats, Floats]:
        """X_TG at the grasp and at the place, and X_OG, (4, 4) each."""
        X_pick = self._lifted(downwards(yaw, grasp.p_TG), self._config.lip_gap)
        return X_pick, self._at_place(X_pick), inverse(self._X_TO) @ X_pick

    def ends_free(self, X_OG: Floats, q_pick: Floats, q_place: Floats) -> tuple[End, End] | None:
        """Both ends of the object's way; None if the arm or the object is in collision there."""
        self._set_up("approach", X_OG)
        pick, place = ((X_TO @ X_OG)[:2, 3] for X_TO in (self._X_TO, self._X_TO_place))
        if self._free(q_pick[None], End(pick, {}), 1, "at the grasp") is None:
            return None
        self._set_up("carry", X_OG)
        ends = End(pick, self._beside(q_pick)), End(place, self._beside(q_place))
        return None if self._free(q_place[None], ends[1], 2, "at the place") is None else ends

    def _beside(self, q: Floats) -> dict[str, float]:
        name = self._picked.name
        close = [here for here in self._scene.close(q, self._config.clearance) if here.pair[0] == name]
        return {here.pair[1]: here.distance - SLACK for here in sorted(close, key=lambda here: -here.distance)}

    def exist(self, grasp: Grasp) -> bool:
        """Whether some yaw and branch reach both ends without collision."""
        return any(self.ends_free(self._poses(grasp, yaw)[2], q, p) is not None for q, p, _, yaw in self.ends(grasp))

    def carry_out(self, grasp: Grasp, q_pick: Floats, q_place: Floats, branch: int, yaw: float) -> Plan | None:
        """A plan with this grasp, yaw and branch, at the least height that is free; None if there is none."""
        self.count += 1
        X_pick, X_place, X_OG = self._poses(grasp, yaw)
        ends = self.ends_free(X_OG, q_pick, q_place)
        if ends is None:
            return None
        name, hangs = self._picked.name, X_pick[2, 3] - self._picked.bounds_T[0][2]
        for bottom in self._bottoms:
            self.count += 1
            up = self._column(X_pick, bottom + hangs, branch, q_pick)
            down = self._column(X_place, bottom + hangs, branch, q_place)
            if up is None or down is None:
                self.fail(3, PlanFailure.UNREACHABLE, "above the grasp" if up is None else "above the place", bottom + hangs)
                return None
            phases = self._phases(grasp, X_OG, up, down, branch, ends)
            if phases is not None:
                x, y, z = (float(v) for v in inverse(X_OG)[:3, 3])
                descent = self._descent(X_OG, q_place, branch)
                mass = self._picked.object_class.mass
                return Plan(name, self._picked.X_TO, self._place, X_OG, mass, (x, y, z), phases, self.count, 0.0, descent)
        return None

    def _descent(self, X_OG: Floats, q_place: Floats, branch: int) -> Trajectory | None:
        """Straight down from the place as far as it is asked for, and the arm is free; what it holds may touch anything."""
        X_place, way = matrix(self._place) @ X_OG, [q_place]
        heights = np.arange(0.0, self._config.descent + 1e-9, _DESCENT_STEP)
        self._set_up("retreat", X_OG)
        self._scene.put_one(self._picked.name, self._place.moved((0.0, 0.0, -10.0)))
        for height in heights[1:]:
            q = nearest_turns(self._reach(self._lifted(X_place, -height))[branch], way[-1])
            jumps = not np.abs(q - way[-1]).max() < _JUMP  # also if it is out of reach, and so not a number
            if jumps or self._free(q[None], End(X_place[:2, 3], {}), 0, "the descent") is None:
                break
            way.append(q)
        if len(way) == 1:
            return None
        return PiecewisePolynomial.FirstOrderHold(heights[: len(way)] / DESCENT_SPEED, np.array(way).T)

    def _phases(
        self, grasp: Grasp, X_OG: Floats, up: Floats, down: Floats, branch: int, ends: tuple[End, End]
    ) -> tuple[Phase, ...] | None:
        empty = Payload()
        across = straight(up[-1], down[-1])
        ways = {
            "carry": ([np.vstack([up, across[1:-1], down[::-1]])], grasp.payload),
            "approach": ([np.vstack([up, way[1:]])[::-1] for way in self._homewards(up[-1], branch)], empty),
            "retreat": ([np.vstack([down, way[1:]]) for way in self._homewards(down[-1], branch)], empty),
        }
        found = {}
        for progress, (name, (choices, payload)) in enumerate(ways.items(), start=4):
            phase = next((made for way in choices if (made := self._phase(name, way, payload, X_OG, ends, progress))), None)
            if phase is None:
                return None
            found[name] = phase
        if self._config.optimise:
            found = {name: self._shortened(found[name], payload, X_OG, ends) for name, (_, payload) in ways.items()}
        return found["approach"], found["carry"], found["retreat"]

    def _homewards(self, start: Floats, branch: int) -> list[Floats]:
        """(n, 6) each: straight home, and at the same height until the cup is where it is at home, seen from above."""
        X_TB, X_FG = self._cell.robot.X_TB.GetAsMatrix4(), self._cell.gripper.X_FG.GetAsMatrix4()
        X_TG_home, X_TG = (X_TB @ forward_kinematics(q) @ X_FG for q in (self._home, start))
        X_TG[:2, 3] = X_TG_home[:2, 3]
        back = nearest_turns(self._reach(X_TG)[branch], start)
        direct = straight(start, self._home)
        if not np.isfinite(back).all():
            return [direct]
        return [direct, np.vstack([straight(start, back), straight(back, self._home)[1:]])]

    def _phase(
        self,
        name: str,
        way: Floats,
        payload: Payload,
        X_OG: Floats,
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

    def _set_up(self, phase: str, X_OG: Floats) -> None:
        """The scene as it is during a phase."""
        name = self._picked.name
        self._scene.release()
        self._scene.put_one(name, self._place if phase == "retreat" else self._picked.X_TO)
        if phase == "carry":
            self._scene.hold(name, inverse(X_OG))

    def _checked(
        self,
        phase: str,
        path: Trajectory,
        X_OG: Floats,
        ends: tuple[End, End],
        progress: int,
        spacing: float = SPACING / 2,
    ) -> Clearance | None:
        """The least clearance along a path, looked at every so many radians; None if it is too little."""
        self._set_up(phase, X_OG)
        points = sampled(path, spacing)
        if phase != "carry":
            return self._free(points, End(ends[int(phase == "retreat")].at, {}), progress, phase)
        half = len(points) // 2  # what it touched at the start it has left by then
        found = [self._free(points[:half], ends[0], progress, phase)]
        if found[0] is not None:
            found.append(self._free(points[half:], ends[1], progress, phase))
        return None if None in found else min((c for c in found if c), key=lambda c: c.distance)

    def _shortened(self, phase: Phase, payload: Payload, X_OG: Floats, ends: tuple[End, End]) -> Phase:
        """The phase along a quicker way; as it is if none is found."""
        self._set_up(phase.name, X_OG)
        least, carried = self._config.clearance + SPARE, phase.name == "carry"
        away = End(ends[int(phase.name == "retreat")].at, {})

        def walls(q: Floats, along: float) -> list[Wall]:
            found = []
            for here, gradient in self._scene.gradients(q, NEAR):
                needed = self._needed(here, ends[int(along >= 0.5)] if carried else away, least)
                if np.abs(gradient).max() > 1e-6:  # some of the wrist's parts are always as far apart
                    found.append(Wall(gradient, here.distance - needed))
            return found

        upright = phase.name != "approach", phase.name != "retreat"  # at home it may go any way
        quick = shortened(Way(phase.trajectory, upright, carried, payload.along_axis, walls, self._scene.cup_jacobian))
        trajectory = slowed(quick, self._cell, payload) if quick else None
        if trajectory is None or trajectory.end_time() >= phase.sure:
            return phase
        # It goes round edges as near as it may: looked at more closely than a way that rises over everything.
        clearance = self._checked(phase.name, trajectory, X_OG, ends, 0, SPACING / 4)
        if clearance is None:
            return phase
        return Phase(phase.name, trajectory, clearance, phase.sure)
