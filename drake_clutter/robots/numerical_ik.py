"""Numerical inverse kinematics of serial arms by damped least squares, compiled.

The damping is the squared error (Chan and Lawrence 1988, "General inverse kinematics with the error
damped pseudoinverse"). In an arm with more than six joints, a null-space motion towards the home
configuration makes solutions of neighboring poses similar.

Frames: B is the robot's base, F is its flange.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from drake_clutter.compilation import njit
from drake_clutter.robots.inverse_kinematics import MAX_JOINT_JUMP
from drake_clutter.robots.joint_range import FULL_TURN, JointRange
from drake_clutter.robots.serial_chain import SerialChain, chain_frames, chain_jacobian

Floats = NDArray[np.float64]

MAX_SOLUTIONS = 8
"""Largest number of solutions of a pose."""
_TABLE_SIZE = 20_000
"""Number of random configurations from which starts are selected."""
_NUM_STARTS = 48
"""Number of starts for each pose: the configurations of the table with the closest poses."""
_MIN_SOLUTION_DISTANCE = 0.1
"""Solutions that differ by less in every joint are duplicates [rad]."""
_ROTATION_WEIGHT = 0.5
"""Weight of the axes of the flange relative to its position in units of the arm's length, in the
distance between poses."""
_MAX_ITERATIONS = 40
"""Largest number of iterations from a start."""
_NULL_SPACE_ITERATIONS = 20
"""First iterations, in which a redundant arm has a null-space motion towards home."""
_NULL_SPACE_GAIN = 0.5
"""Fraction of the distance to home that is desired in one iteration."""
_ABANDON_ITERATION = 12
"""Iteration at which a start is abandoned if its squared error is large."""
_ABANDON_SQUARED_ERROR = 0.05
"""Squared error above which a start is abandoned [rad^2 and m^2]."""
_ERROR_TOLERANCE = 1e-10
"""Largest error of a solution, rotation [rad] and position [m] combined."""


@dataclass(frozen=True, eq=False)
class NumericalInverseKinematics:
    """Damped least squares from the closest configurations of a table; deterministic.

    Attributes:
        chain: Kinematic chain of the arm.
        joint_range: Joint limits.
        home: Home configuration. Solutions are sorted by their distance from it. Shape (n,).
    """

    chain: SerialChain
    joint_range: JointRange
    home: Floats

    @property
    def num_solutions(self) -> int:
        """Largest number of solutions of a pose."""
        return MAX_SOLUTIONS

    @cached_property
    def _start_range(self) -> Floats:
        """Limits of the table's configurations, at most one full turn. Shape (n, 2)."""
        center = self.joint_range.limits.mean(axis=1, keepdims=True)
        turn = center + np.array([-np.pi, np.pi])
        return np.where(self.joint_range.exceeds_full_turn[:, None], turn, self.joint_range.limits)

    @cached_property
    def _start_table(self) -> tuple[Floats, cKDTree]:
        """Random configurations, shape (_TABLE_SIZE, n), and a k-d tree of their poses."""
        lower, upper = self._start_range.T
        q = np.random.default_rng(0).uniform(lower, upper, (_TABLE_SIZE, len(lower)))
        return q, cKDTree(self._pose_features(self.chain.forward_kinematics(q)))

    def _pose_features(self, X_BF: Floats) -> Floats:
        """Return points, shape (..., 9), whose Euclidean distance compares poses."""
        reach = np.linalg.norm(self.chain.fixed[:, :3, 3], axis=1).sum()
        rotation = X_BF[..., :3, [0, 2]].reshape(*X_BF.shape[:-2], 6)
        return np.concatenate([X_BF[..., :3, 3] / reach, _ROTATION_WEIGHT * rotation], axis=-1)

    def solve(self, X_BF: Floats) -> Floats:
        """Return distinct solutions, the closest to home first, see `InverseKinematics`."""
        X = np.ascontiguousarray(X_BF, float).reshape(-1, 4, 4)
        q_table, tree = self._start_table
        starts = q_table[tree.query(self._pose_features(X), _NUM_STARTS)[1]]
        q = _solve_poses(*self._arm_arguments, X, starts)
        lower = self._start_range[:, 0]
        q = np.where(self.joint_range.exceeds_full_turn, (q - lower) % FULL_TURN + lower, q)
        order = np.argsort(np.linalg.norm(q - self.home, axis=-1), axis=-1, kind="stable")
        q = np.take_along_axis(q, order[..., None], axis=1)
        return np.asarray(q.reshape(*X_BF.shape[:-2], MAX_SOLUTIONS, self.chain.num_joints))

    @property
    def _arm_arguments(self) -> tuple[Floats, NDArray[np.bool_], Floats, Floats]:
        return self.chain.fixed, self.chain.revolute, self.joint_range.limits, self.home

    def match(self, q_from: Floats, q_to: Floats) -> Floats:
        """Return solutions at the poses of `q_to` close to `q_from`.

        Iterations start at each row of `q_from`. A row of `q_to` replaces the result if it is
        closer. A redundant arm so keeps its posture from pose to pose.
        """
        start, target = np.broadcast_arrays(q_from, q_to)
        rows = start.shape[-2:]
        start = start.reshape(-1, *rows)
        target = target.reshape(-1, *rows)
        is_reachable = np.isfinite(target[..., 0]).any(axis=-1)
        first_solution = np.isfinite(target[..., 0]).argmax(axis=-1)
        X_BF = self.chain.forward_kinematics(target[np.arange(len(target)), first_solution])
        matched = np.full(start.shape, np.nan)
        for k in np.flatnonzero(is_reachable):
            near = _solve_from_starts(*self._arm_arguments, X_BF[k], np.ascontiguousarray(start[k]))
            for row in np.flatnonzero(np.isfinite(start[k, :, 0])):
                candidates = np.vstack([near[row], target[k]])
                matched[k, row] = self._nearest(candidates, start[k, row])
        return matched.reshape(np.broadcast_shapes(q_from.shape, q_to.shape))

    def _nearest(self, candidates: Floats, q: Floats) -> Floats:
        """Return the row of candidates (k, n) with the smallest displacement from q (n,)."""
        distances = np.abs(self.joint_range.unwrap(candidates, q) - q).max(axis=-1)
        return np.asarray(candidates[np.nanargmin(distances)])

    def track(self, X_BF: Floats, q_start: Floats) -> Floats | None:
        """Return the path in which each pose starts from the previous solution."""
        path = np.empty((len(X_BF), len(q_start)))
        path[0] = q_start
        is_continuous = _track_path(*self._arm_arguments, np.ascontiguousarray(X_BF, float), path)
        return path if is_continuous else None

    def follow(self, X_BF: Floats, q: Floats) -> Floats | None:
        """Return the closest solution to `q` that is found, see `InverseKinematics`."""
        near = _solve_from_starts(
            *self._arm_arguments, np.ascontiguousarray(X_BF, float), q[None].copy()
        )
        candidates = np.vstack([near, self.solve(X_BF)])
        if np.isnan(candidates).all():
            return None
        return self.joint_range.unwrap(self._nearest(candidates, q), q)


@njit(cache=True)
def _pose_error(X_target, X, e):  # type: ignore[no-untyped-def]
    """Write the error twist from X to X_target into e (6,); return e^T e."""
    R = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            R[i, j] = X_target[i, 0] * X[j, 0] + X_target[i, 1] * X[j, 1] + X_target[i, 2] * X[j, 2]
        e[3 + i] = X_target[i, 3] - X[i, 3]
    e[0], e[1], e[2] = (R[2, 1] - R[1, 2]) / 2, (R[0, 2] - R[2, 0]) / 2, (R[1, 0] - R[0, 1]) / 2
    sine = np.sqrt(e[0] ** 2 + e[1] ** 2 + e[2] ** 2)
    angle = np.arctan2(sine, (R[0, 0] + R[1, 1] + R[2, 2] - 1) / 2)
    if sine > 1e-8:
        for i in range(3):
            e[i] *= angle / sine
    elif angle > 1.0:  # The axis of a half turn is undetermined: use x.
        e[0] = angle
    return e[0] ** 2 + e[1] ** 2 + e[2] ** 2 + e[3] ** 2 + e[4] ** 2 + e[5] ** 2


@njit(cache=True)
def _solve_cholesky(A, b):  # type: ignore[no-untyped-def]
    """Solve A x = b by Cholesky decomposition, in place of A (6, 6) and b (6,)."""
    for j in range(6):
        for k in range(j):
            for i in range(j, 6):
                A[i, j] -= A[i, k] * A[j, k]
        root = np.sqrt(max(A[j, j], 1e-300))
        for i in range(j, 6):
            A[i, j] /= root
    for i in range(6):
        for k in range(i):
            b[i] -= A[i, k] * b[k]
        b[i] /= A[i, i]
    for i in range(5, -1, -1):
        for k in range(i + 1, 6):
            b[i] -= A[k, i] * b[k]
        b[i] /= A[i, i]


@njit(cache=True)
def _damped_step(J, e, damping, dq_null, dq):  # type: ignore[no-untyped-def]
    """Write J^T (J J^T + damping I)^-1 (e - J dq_null) + dq_null into dq (n,)."""
    n = J.shape[1]
    A = np.empty((6, 6))
    b = np.empty(6)
    for i in range(6):
        b[i] = e[i]
        for k in range(n):
            b[i] -= J[i, k] * dq_null[k]
        for j in range(i + 1):
            A[i, j] = 0.0
            for k in range(n):
                A[i, j] += J[i, k] * J[j, k]
        A[i, i] += damping
    _solve_cholesky(A, b)
    for k in range(n):
        dq[k] = dq_null[k]
        for i in range(6):
            dq[k] += J[i, k] * b[i]


@njit(cache=True)
def _iterate(fixed, revolute, limits, home, X, q, null_space_iterations):  # type: ignore[no-untyped-def]
    """Iterate q (n,) in place until the flange is at X (4, 4); return success.

    The first iterations have a null-space motion towards home.
    """
    n = len(q)
    frames, moved = np.empty((n + 1, 4, 4)), np.empty((n, 3, 4))
    J = np.empty((6, n))
    e = np.empty(6)
    dq_null = np.zeros(n)
    dq = np.empty(n)
    for iteration in range(_MAX_ITERATIONS):
        chain_frames(fixed, revolute, q, frames, moved)
        squared_error = _pose_error(X, frames[n], e)
        if iteration >= null_space_iterations and squared_error < _ERROR_TOLERANCE**2:
            return True
        if iteration == _ABANDON_ITERATION and squared_error > _ABANDON_SQUARED_ERROR:
            return False
        chain_jacobian(frames, revolute, J)
        for k in range(n):
            dq_null[k] = (
                _NULL_SPACE_GAIN * (home[k] - q[k]) if iteration < null_space_iterations else 0.0
            )
        _damped_step(J, e, squared_error + 1e-12, dq_null, dq)
        for k in range(n):
            q[k] = min(max(q[k] + dq[k], limits[k, 0]), limits[k, 1])
    return False


@njit(cache=True)
def _solve_poses(fixed, revolute, limits, home, X, starts):  # type: ignore[no-untyped-def]
    """Return distinct solutions of poses X (m, 4, 4), shape (m, MAX_SOLUTIONS, n).

    Starts have shape (m, num_starts, n); rows without a solution are NaN.
    """
    n = len(revolute)
    solutions = np.full((len(X), MAX_SOLUTIONS, n), np.nan)
    for k in range(len(X)):
        count = 0
        for start in range(starts.shape[1]):
            q = starts[k, start].copy()
            iterations = _NULL_SPACE_ITERATIONS if n > 6 and start % 2 == 0 else 0
            if not _iterate(fixed, revolute, limits, home, X[k], q, iterations):
                continue
            is_new = True
            for other in range(count):
                distance = 0.0
                for joint in range(n):
                    difference = abs(q[joint] - solutions[k, other, joint])
                    if revolute[joint]:
                        difference = abs((difference + np.pi) % (2 * np.pi) - np.pi)
                    distance = max(distance, difference)
                is_new = is_new and distance > _MIN_SOLUTION_DISTANCE
            if is_new:
                solutions[k, count] = q
                count += 1
                if count == MAX_SOLUTIONS:
                    break
    return solutions


@njit(cache=True)
def _solve_from_starts(fixed, revolute, limits, home, X, starts):  # type: ignore[no-untyped-def]
    """Return the solutions of X (4, 4) from starts (K, n); NaN without convergence."""
    solutions = starts.copy()
    for k in range(len(starts)):
        if not _iterate(fixed, revolute, limits, home, X, solutions[k], 0):
            solutions[k] = np.nan
    return solutions


@njit(cache=True)
def _track_path(fixed, revolute, limits, home, X, path):  # type: ignore[no-untyped-def]
    """Write the path (m, n) along X (m, 4, 4) from its first row; return success."""
    for k in range(1, len(X)):
        path[k] = path[k - 1]
        if not _iterate(fixed, revolute, limits, home, X[k], path[k], 0):
            return False
        if np.abs(path[k] - path[k - 1]).max() > MAX_JOINT_JUMP:
            return False
    return True
