"""Inverse kinematics of any serial arm by damped least squares from many starts, compiled.

The damping is the squared error (Chan and Lawrence 1988, "General inverse kinematics with the error
damped pseudoinverse"). An arm with more than six joints is drawn towards its home within the null
space of the Jacobian, so that neighboring poses have neighboring solutions.

Frames: B the base; F the flange.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from drake_clutter.robots.inverse_kinematics import MAX_JOINT_JUMP
from drake_clutter.robots.joint_range import FULL_TURN, JointRange
from drake_clutter.robots.serial_chain import SerialChain, chain_frames, chain_jacobian

Floats = NDArray[np.float64]

MAX_SOLUTIONS = 8
"""Solutions of one pose that are looked for."""
_TABLE_SIZE = 20_000
"""Configurations among which starts are chosen."""
_NUM_STARTS = 48
"""Starts for each pose; those of the table whose poses are nearest."""
_MIN_SOLUTION_DISTANCE = 0.1
"""Solutions that differ less in every joint are one [rad]."""
_ROTATION_WEIGHT = 0.5
"""Of the flange's axes beside its position in units of the arm's length, to choose starts."""
_MAX_ITERATIONS = 40
_NULL_SPACE_ITERATIONS = 20
"""Iterations in which a redundant arm is drawn to its home."""
_NULL_SPACE_GAIN = 0.5
"""Share of the way home that is taken in one of them."""
_ABANDON_ITERATION = 12
"""Iterations after which a start that is not near a solution is given up."""
_ERROR_TOLERANCE = 1e-10
"""Error of a solution [rad and m]."""


@dataclass(frozen=True, eq=False)
class NumericalInverseKinematics:
    """Damped least squares from the nearest configurations of a table; deterministic.

    Attributes:
        chain: The arm.
        joint_range: Range of the joints.
        home: Redundant arms are drawn to it; solutions near to it come first. Shape (n,).
    """

    chain: SerialChain
    joint_range: JointRange
    home: Floats

    @property
    def num_solutions(self) -> int:
        """Solutions that are given for each pose at most."""
        return MAX_SOLUTIONS

    @cached_property
    def _start_range(self) -> Floats:
        """Positions that are tried: one turn at most. Shape (n, 2)."""
        middle = self.joint_range.limits.mean(axis=1, keepdims=True)
        turn = middle + np.array([-np.pi, np.pi])
        return np.where(self.joint_range.exceeds_full_turn[:, None], turn, self.joint_range.limits)

    @cached_property
    def _start_table(self) -> tuple[Floats, cKDTree]:
        """Configurations, and a tree of their flanges' poses."""
        lower, upper = self._start_range.T
        q = np.random.default_rng(0).uniform(lower, upper, (_TABLE_SIZE, len(lower)))
        return q, cKDTree(self._pose_features(self.chain.forward_kinematics(q)))

    def _pose_features(self, X_BF: Floats) -> Floats:
        reach = np.linalg.norm(self.chain.fixed[:, :3, 3], axis=1).sum()
        rotation = X_BF[..., :3, [0, 2]].reshape(*X_BF.shape[:-2], 6)
        return np.concatenate([X_BF[..., :3, 3] / reach, _ROTATION_WEIGHT * rotation], axis=-1)

    def solve(self, X_BF: Floats) -> Floats:
        """Return distinct solutions, the nearest to home first, see `InverseKinematics`."""
        X = np.ascontiguousarray(X_BF, float).reshape(-1, 4, 4)
        q_table, tree = self._start_table
        starts = q_table[tree.query(self._pose_features(X), _NUM_STARTS)[1]]
        found = _solve_poses(*self._arm_arguments, X, starts)
        lower = self._start_range[:, 0]
        found = np.where(
            self.joint_range.exceeds_full_turn, (found - lower) % FULL_TURN + lower, found
        )
        order = np.argsort(np.linalg.norm(found - self.home, axis=-1), axis=-1, kind="stable")
        found = np.take_along_axis(found, order[..., None], axis=1)
        return np.asarray(found.reshape(*X_BF.shape[:-2], MAX_SOLUTIONS, self.chain.num_joints))

    @property
    def _arm_arguments(self) -> tuple[Floats, NDArray[np.bool_], Floats, Floats]:
        return self.chain.fixed, self.chain.revolute, self.joint_range.limits, self.home

    def match(self, q_from: Floats, q_to: Floats) -> Floats:
        """Return solutions near to q_from at the poses of q_to, see `InverseKinematics`.

        Each is what iterations that start at a row of q_from lead to, or a row of q_to if that is
        nearer; so a redundant arm need not change its posture from pose to pose.
        """
        start, given = np.broadcast_arrays(q_from, q_to)
        rows = start.shape[-2:]
        start, given = start.reshape(-1, *rows), given.reshape(-1, *rows)
        there = np.isfinite(given[..., 0]).any(axis=-1)
        found = np.full(start.shape, np.nan)
        which = np.isfinite(given[..., 0]).argmax(axis=-1)
        X_BF = self.chain.forward_kinematics(given[np.arange(len(given)), which])
        for k in np.flatnonzero(there):
            near = _solve_from_starts(*self._arm_arguments, X_BF[k], np.ascontiguousarray(start[k]))
            for row in np.flatnonzero(np.isfinite(start[k, :, 0])):
                choice = np.vstack([near[row], given[k]])
                found[k, row] = self._nearest(choice, start[k, row])
        return found.reshape(np.broadcast_shapes(q_from.shape, q_to.shape))

    def _nearest(self, choice: Floats, q: Floats) -> Floats:
        apart = np.abs(self.joint_range.unwrap(choice, q) - q).max(axis=-1)
        return np.asarray(choice[np.nanargmin(apart)])

    def track(self, X_BF: Floats, q_start: Floats) -> Floats | None:
        """Return the path that goes on from q_start step by step, see `InverseKinematics`."""
        path = np.empty((len(X_BF), len(q_start)))
        path[0] = q_start
        on_the_way = _track_path(*self._arm_arguments, np.ascontiguousarray(X_BF, float), path)
        return path if on_the_way else None

    def follow(self, X_BF: Floats, q: Floats) -> Floats | None:
        """Return a solution near to q, see `InverseKinematics`."""
        near = _solve_from_starts(
            *self._arm_arguments, np.ascontiguousarray(X_BF, float), q[None].copy()
        )
        choice = np.vstack([near, self.solve(X_BF)])
        if np.isnan(choice).all():
            return None
        return self.joint_range.unwrap(self._nearest(choice, q), q)


@njit(cache=True)
def _pose_error(X_target, X, e):  # type: ignore[no-untyped-def]
    """Write rotation vector and shift from X to X_target into e (6,); return e^2."""
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
    elif angle > 1.0:  # half a turn: any axis leads on
        e[0] = angle
    return e[0] ** 2 + e[1] ** 2 + e[2] ** 2 + e[3] ** 2 + e[4] ** 2 + e[5] ** 2


@njit(cache=True)
def _solve_cholesky(A, b):  # type: ignore[no-untyped-def]
    """Solve A x = b in place of b by Cholesky's method; A (6, 6) is overwritten."""
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
    """Write J^T (J J^T + damping)^-1 (e - J pull) + pull into dq."""
    n = J.shape[1]
    A, b = np.empty((6, 6)), np.empty(6)
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
    """Move q (n,) until the flange is at X, first drawn to home; False if it does not arrive."""
    n = len(q)
    frames, J, e = np.empty((n + 1, 4, 4)), np.empty((6, n)), np.empty(6)
    pull, dq = np.zeros(n), np.empty(n)
    for iteration in range(_MAX_ITERATIONS):
        chain_frames(fixed, revolute, q, frames)
        square = _pose_error(X, frames[n], e)
        if iteration >= null_space_iterations and square < _ERROR_TOLERANCE**2:
            return True
        if iteration == _ABANDON_ITERATION and square > 0.05:
            return False
        chain_jacobian(frames, revolute, J)
        for k in range(n):
            pull[k] = (
                _NULL_SPACE_GAIN * (home[k] - q[k]) if iteration < null_space_iterations else 0.0
            )
        _damped_step(J, e, square + 1e-12, pull, dq)
        for k in range(n):
            q[k] = min(max(q[k] + dq[k], limits[k, 0]), limits[k, 1])
    return False


@njit(cache=True)
def _solve_poses(fixed, revolute, limits, home, X, starts):  # type: ignore[no-untyped-def]
    n = len(revolute)
    found = np.full((len(X), MAX_SOLUTIONS, n), np.nan)
    for k in range(len(X)):
        count = 0
        for start in range(starts.shape[1]):
            q = starts[k, start].copy()
            drawn = _NULL_SPACE_ITERATIONS if n > 6 and start % 2 == 0 else 0
            if not _iterate(fixed, revolute, limits, home, X[k], q, drawn):
                continue
            new = True
            for other in range(count):
                apart = 0.0
                for joint in range(n):
                    difference = abs(q[joint] - found[k, other, joint])
                    if revolute[joint]:
                        difference = abs((difference + np.pi) % (2 * np.pi) - np.pi)
                    apart = max(apart, difference)
                new = new and apart > _MIN_SOLUTION_DISTANCE
            if new:
                found[k, count] = q
                count += 1
                if count == MAX_SOLUTIONS:
                    break
    return found


@njit(cache=True)
def _solve_from_starts(fixed, revolute, limits, home, X, starts):  # type: ignore[no-untyped-def]
    """Return where iterations from starts (K, n) lead; NaN where they do not reach X (4, 4)."""
    found = starts.copy()
    for k in range(len(starts)):
        if not _iterate(fixed, revolute, limits, home, X, found[k], 0):
            found[k] = np.nan
    return found


@njit(cache=True)
def _track_path(fixed, revolute, limits, home, X, path):  # type: ignore[no-untyped-def]
    for k in range(1, len(X)):
        path[k] = path[k - 1]
        if not _iterate(fixed, revolute, limits, home, X[k], path[k], 0):
            return False
        if np.abs(path[k] - path[k - 1]).max() > MAX_JOINT_JUMP:
            return False
    return True
