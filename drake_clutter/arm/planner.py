"""Finds plans of moves: grasp, way and timing.

Frames: T the tray, B the arm's base, F the flange, G the cup, O the picked object.
"""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydrake.trajectories import Trajectory

from drake_clutter.arm.clearance import Clearance, ClearanceScene
from drake_clutter.arm.kinematics import branches
from drake_clutter.arm.paths import Payload, nearest_turns, sampled, smooth, straight, timed
from drake_clutter.arm.plan import NoPlan, Phase, Plan, PlanFailure
from drake_clutter.arm.station import ArmConfig
from drake_clutter.arm.suction import EPICK_MASS, greatest_acceleration, unevenness
from drake_clutter.catalogue import ObjectClass
from drake_clutter.scenes.scene import Pose, SceneObject

Floats = NDArray[np.float64]


@dataclass
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
        time_limit: s.
    """

    clearance: float = 0.005
    rise: float = 0.020
    lip_gap: float = 0.0005
    grasp_spacing: float = 0.012
    grasps: int = 9
    yaws: int = 12
    attempts: int = 400
    least_acceleration: float = 0.3
    time_limit: float = 5.0


REPORTED = 0.03
"""m; what is further away than this counts as free."""
SLACK = 0.0005
"""m, by which the held object may come closer to what it touches at an end of its way."""
_VERTICAL_STEP = 0.02
"""m, between the points of a vertical way."""


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


def _downwards(yaw: float, p_TG: Floats) -> Floats:
    """(4, 4) X_TG of a cup that points down."""
    c, s = math.cos(yaw), math.sin(yaw)
    X = np.eye(4)
    X[:3, :3] = np.array([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]])
    X[:3, 3] = p_TG
    return X


@dataclass(frozen=True)
class _Grasp:
    """Where the cup goes.

    Attributes:
        p_TG: (3,) m, on the top face.
        payload: what the cup then carries.
    """

    p_TG: Floats
    payload: Payload


class PickPlacePlanner:
    """Plans moves of objects among objects; the same question has the same answer."""

    def __init__(self, config: ArmConfig, planner: PlannerConfig, tray_side: float, camera_altitude: float) -> None:
        self.config, self.planner = config, planner
        self.tray_side, self._camera_altitude = tray_side, camera_altitude
        self._X_BT, self._X_GF = inverse(config.X_TB), inverse(config.X_FG)
        self._scenes: dict[tuple[tuple[str, ObjectClass], ...], ClearanceScene] = {}

    def clearance_scene(self, objects: Sequence[SceneObject]) -> ClearanceScene:
        """The objects and the arm; the latest of each set of objects is kept."""
        key = tuple((o.name, o.object_class) for o in objects)
        if key not in self._scenes:
            self._scenes.clear()
            self._scenes[key] = ClearanceScene(self.config, key, self.tray_side, self._camera_altitude)
        scene = self._scenes[key]
        scene.put(objects)
        return scene

    def plan(self, objects: Sequence[SceneObject], pick: str, X_TO_place: Pose) -> Plan | NoPlan:
        """Plans to carry an object to a pose that differs by a shift and a turn about the vertical.

        Args:
            objects: all that is known to stand around, the picked one included.
            pick: its name.
            X_TO_place: where it is let go.
        """
        begun = time.perf_counter()
        picked = next(o for o in objects if o.name == pick)
        found = self._plan(objects, picked, X_TO_place, begun)
        return replace(found, seconds=time.perf_counter() - begun)

    def _plan(self, objects: Sequence[SceneObject], picked: SceneObject, X_TO_place: Pose, begun: float) -> Plan | NoPlan:
        if carried := rests_on(picked, objects):
            return NoPlan(PlanFailure.CARRIES_OTHERS, ", ".join(carried))
        grasps = self._grasps(picked)
        if isinstance(grasps, NoPlan):
            return grasps
        scene = self.clearance_scene(objects)
        attempt = _Attempts(self, scene, objects, picked, X_TO_place)
        for grasp in grasps:
            for q_pick, q_place, branch, yaw in attempt.ends(grasp):
                if attempt.count >= self.planner.attempts:
                    return attempt.furthest
                if time.perf_counter() - begun > self.planner.time_limit:
                    return NoPlan(PlanFailure.TIME_OUT, str(attempt.furthest), self.planner.time_limit)
                found = attempt.carry_out(grasp, q_pick, q_place, branch, yaw)
                if found is not None:
                    return found
        return attempt.furthest

    def _grasps(self, picked: SceneObject) -> list[_Grasp] | NoPlan:
        """Where the cup seals on top and can hold, the nearest to its middle first."""
        suction = self.config.suction
        lower, upper = picked.bounds_T
        X_TO = matrix(picked.X_TO)
        top = float(upper[2])
        steps = [np.arange(0, (hi - lo) / 2, self.planner.grasp_spacing) for lo, hi in zip(lower[:2], upper[:2], strict=True)]
        offsets = [np.concatenate([-s[:0:-1], s]) for s in steps]
        x, y = np.meshgrid(*offsets, indexing="ij")
        middle = (lower[:2] + upper[:2]) / 2
        points = middle + np.column_stack([x.ravel(), y.ravel()])
        points = points[np.argsort(np.round(np.linalg.norm(points - middle, axis=1), 6), kind="stable")]
        found, least = list[_Grasp](), math.inf
        for point in points:
            X_TG = _downwards(0.0, np.array([*point, top]))
            X_OG = inverse(X_TO) @ X_TG
            uneven = unevenness(picked.object_class, X_OG, suction.cup_diameter)
            least = min(least, uneven)
            if uneven > suction.unevenness:
                continue
            p_GCm = inverse(X_TG)[:3, :3] @ (X_TO[:3, 3] - X_TG[:3, 3])
            acceleration = greatest_acceleration(picked.object_class.mass, p_GCm, suction)
            if acceleration >= self.planner.least_acceleration:
                # How the load hangs to the side depends on the cup's yaw; its distance from the axis does not.
                payload = Payload(picked.object_class.mass, (0.0, 0.0, round(float(p_GCm[2]), 2)), round(acceleration, 1))
                found.append(_Grasp(X_TG[:3, 3], payload))
                if len(found) == self.planner.grasps:
                    break
        if picked.object_class.mass + EPICK_MASS > self.config.payload:
            return NoPlan(PlanFailure.TOO_HEAVY, picked.name, picked.object_class.mass)
        if not found:
            reason = PlanFailure.NO_SEAL if least > suction.unevenness else PlanFailure.TOO_HEAVY
            return NoPlan(reason, picked.name, least if reason is PlanFailure.NO_SEAL else picked.object_class.mass)
        return found

    def ends_exist(self, objects: Sequence[SceneObject], pick: str, X_TO_place: Pose) -> bool:
        """Whether any grasp that holds reaches both ends of a move without collision: what no plan can do without."""
        picked = next(o for o in objects if o.name == pick)
        grasps = self._grasps(picked)
        if rests_on(picked, objects) or isinstance(grasps, NoPlan):
            return False
        attempts = _Attempts(self, self.clearance_scene(objects), objects, picked, X_TO_place)
        return any(attempts.exist(grasp) for grasp in grasps)

    def reach(self, X_TG: Floats) -> Floats:
        """(..., 8, 6) rad, see `branches`."""
        return branches(self._X_BT @ X_TG @ self._X_GF)


class _Attempts:
    """The search for one move: grasps, yaws, branches and heights, until a way is free."""

    def __init__(
        self,
        planner: PickPlacePlanner,
        scene: ClearanceScene,
        objects: Sequence[SceneObject],
        picked: SceneObject,
        X_TO_place: Pose,
    ) -> None:
        self._planner, self._config, self._scene, self._picked = planner, planner.planner, scene, picked
        self._X_TO, self._X_TO_place, self._place = matrix(picked.X_TO), matrix(X_TO_place), X_TO_place
        self.count, self.furthest = 0, NoPlan(PlanFailure.UNREACHABLE, "the grasp")
        self._progress = -1
        placed = replace(picked, X_TO=X_TO_place)
        others = [o for o in objects if o is not picked]
        bottom = max(picked.bounds_T[0][2], placed.bounds_T[0][2])
        tops = sorted({round(o.top, 3) for o in others if o.top > bottom})
        self._bottoms = [bottom + self._config.rise] + [top + self._config.rise for top in tops if top > bottom]
        self._home = np.array(planner.config.home)

    def fail(self, progress: int, reason: PlanFailure, about: str, number: float = math.nan) -> None:
        """Remembers why an attempt failed, if it came further than those before."""
        if progress > self._progress:
            self._progress, self.furthest = progress, NoPlan(reason, about, number)

    def ends(self, grasp: _Grasp) -> list[tuple[Floats, Floats, int, float]]:
        """q at the grasp and at the place, branch and yaw, the shortest way first."""
        yaws = np.arange(self._config.yaws) * (2 * math.pi / self._config.yaws)
        X_pick = np.array([self._lifted(_downwards(yaw, grasp.p_TG), self._config.lip_gap) for yaw in yaws])
        X_place = np.array([self._at_place(X) for X in X_pick])
        q_pick, q_place = self._planner.reach(X_pick), self._planner.reach(X_place)
        found = []
        for k, yaw in enumerate(yaws):
            for branch in range(8):
                if not np.isfinite(q_pick[k, branch, 0]):
                    continue
                if not np.isfinite(q_place[k, branch, 0]):
                    self.fail(0, PlanFailure.UNREACHABLE, "the place")
                    continue
                at_pick = nearest_turns(q_pick[k, branch], self._home)
                at_place = nearest_turns(q_place[k, branch], at_pick)
                length = (
                    np.abs(at_pick - self._home).max() + np.abs(at_place - at_pick).max() + np.abs(at_place - self._home).max()
                )
                found.append((length, at_pick, at_place, branch, float(yaw)))
        found.sort(key=lambda item: item[0])
        return [item[1:] for item in found]

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
        q = self._planner.reach(X)[:, branch]
        if not np.isfinite(q).all():
            return None
        q[0] = start
        for k in range(1, len(q)):
            q[k] = nearest_turns(q[k], q[k - 1])
        return None if np.abs(np.diff(q, axis=0)).max() > 0.5 else q

    def _free(self, way: Floats, beside: Mapping[str, float], progress: int, what: str) -> Clearance | None:
        """The least clearance along a way; None, and the reason is remembered, if it is less than it must be.

        Args:
            way: (n, 6) rad.
            beside: m, how close the held object may come to what it touches at an end of its way, by name.
            progress: see `fail`.
            what: the way is.
        """
        found, name, least = Clearance(math.inf), self._picked.name, self._config.clearance
        for q in way:
            for here in self._scene.close(q, REPORTED):
                allowed = beside.get(here.pair[1], least) if here.pair[0] == name else least
                if here.distance < allowed:
                    self.fail(progress, PlanFailure.IN_COLLISION, f"{what}: {' and '.join(here.pair)}", here.distance)
                    return None
                if allowed == least and here.distance < found.distance:
                    found = here
        return found

    def _beside(self, q: Floats) -> dict[str, float]:
        """What the held object is close to, and how close it may come to that; at joint angles (6,) rad."""
        name = self._picked.name
        close = [here for here in self._scene.close(q, self._config.clearance) if here.pair[0] == name]
        return {here.pair[1]: here.distance - SLACK for here in sorted(close, key=lambda here: -here.distance)}

    def _poses(self, grasp: _Grasp, yaw: float) -> tuple[Floats, Floats, Floats]:
        """X_TG at the grasp and at the place, and X_OG, (4, 4) each."""
        X_pick = self._lifted(_downwards(yaw, grasp.p_TG), self._config.lip_gap)
        return X_pick, self._at_place(X_pick), inverse(self._X_TO) @ X_pick

    def ends_free(self, X_OG: Floats, q_pick: Floats, q_place: Floats) -> tuple[dict[str, float], dict[str, float]] | None:
        """What the object touches at either end, see `_beside`; None if the arm or the object is in collision there."""
        name = self._picked.name
        self._scene.release()
        self._scene.touch(name)
        if self._free(q_pick[None], {}, 1, "at the grasp") is None:
            return None
        self._scene.hold(name, inverse(X_OG))
        beside = self._beside(q_pick), self._beside(q_place)
        return None if self._free(q_place[None], beside[1], 2, "at the place") is None else beside

    def exist(self, grasp: _Grasp) -> bool:
        """Whether some yaw and branch reach both ends without collision."""
        return any(self.ends_free(self._poses(grasp, yaw)[2], q, p) is not None for q, p, _, yaw in self.ends(grasp))

    def carry_out(self, grasp: _Grasp, q_pick: Floats, q_place: Floats, branch: int, yaw: float) -> Plan | None:
        """A plan with this grasp, yaw and branch, at the least height that is free; None if there is none."""
        self.count += 1
        X_pick, X_place, X_OG = self._poses(grasp, yaw)
        beside = self.ends_free(X_OG, q_pick, q_place)
        if beside is None:
            return None
        name, hangs = self._picked.name, X_pick[2, 3] - self._picked.bounds_T[0][2]
        for bottom in self._bottoms:
            self.count += 1
            up = self._column(X_pick, bottom + hangs, branch, q_pick)
            down = self._column(X_place, bottom + hangs, branch, q_place)
            if up is None or down is None:
                self.fail(3, PlanFailure.UNREACHABLE, "above the grasp" if up is None else "above the place", bottom + hangs)
                return None
            phases = self._phases(grasp, X_OG, up, down, beside)
            if phases is not None:
                x, y, z = (float(v) for v in inverse(X_OG)[:3, 3])
                ends = self._picked.X_TO, self._place
                return Plan(name, *ends, X_OG, self._picked.object_class.mass, (x, y, z), phases, self.count, 0.0)
        return None

    def _phases(
        self, grasp: _Grasp, X_OG: Floats, up: Floats, down: Floats, beside: tuple[dict[str, float], dict[str, float]]
    ) -> tuple[Phase, ...] | None:
        home, empty = self._home, Payload()
        across = straight(up[-1], down[-1])
        ways = {
            "carry": (np.vstack([up, across[1:-1], down[::-1]]), grasp.payload),
            "approach": (np.vstack([straight(home, up[-1])[:-1], up[::-1]]), empty),
            "retreat": (np.vstack([down, straight(down[-1], home)[1:]]), empty),
        }
        found = {}
        for progress, (phase, (way, payload)) in enumerate(ways.items(), start=4):
            path = smooth(way)
            clearance = self._checked(phase, path, X_OG, beside, progress)
            if clearance is None:
                return None
            trajectory = timed(path, self._planner.config, payload)
            if trajectory is None:
                self.fail(progress, PlanFailure.TRAJECTORY_INFEASIBLE, phase)
                return None
            found[phase] = Phase(phase, trajectory, clearance)
        return found["approach"], found["carry"], found["retreat"]

    def _checked(
        self, phase: str, path: Trajectory, X_OG: Floats, beside: tuple[dict[str, float], dict[str, float]], progress: int
    ) -> Clearance | None:
        """The least clearance along a path; None if it is too little."""
        scene, name, points = self._scene, self._picked.name, sampled(path)
        scene.release()
        if phase == "carry":
            scene.hold(name, inverse(X_OG))
            half = len(points) // 2  # what it touched at the start it has left by then
            found = [self._free(points[:half], beside[0], progress, phase)]
            if found[0] is not None:
                found.append(self._free(points[half:], beside[1], progress, phase))
            return None if None in found else min((c for c in found if c), key=lambda c: c.distance)
        scene.put_one(name, self._picked.X_TO if phase == "approach" else self._place)
        scene.touch(name)
        along = self._free(points, {}, progress, phase)
        scene.put_one(name, self._picked.X_TO)
        return along


def rests_on(picked: SceneObject, objects: Sequence[SceneObject], margin: float = 0.004) -> tuple[str, ...]:
    """The names of the objects that stand or lean on the picked one: they touch it and reach over it."""
    found = []
    for other in objects:
        if other is picked:
            continue
        (lower, upper), (other_lower, other_upper) = picked.bounds_T, other.bounds_T
        overlap = np.minimum(upper, other_upper)[:2] - np.maximum(lower, other_lower)[:2]
        if overlap.min() > margin and abs(other_lower[2] - upper[2]) < margin:
            found.append(other.name)
    return tuple(found)
