"""Constraints of the control points of a spline, for trajectory optimization.

The spline is a cubic B-spline over the parameter s in [0, 1]. Its control points are the variables
of a convex program, flattened row by row.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from pydrake.math import BsplineBasis, KnotVectorType
from pydrake.solvers import MathematicalProgram
from pydrake.trajectories import BsplineTrajectory
from scipy import sparse
from scipy.linalg import null_space

Floats = NDArray[np.float64]

NUM_CONTROL_POINTS = 28
"""Control points of the spline."""
NUM_FIXED_CONTROL_POINTS = 3
"""Equal control points at either end: they give zero velocity and acceleration there."""
SPLINE_ORDER = 4
"""Order of the spline, one more than its degree."""
NUM_COLLISION_SAMPLES = 50
"""Points of the spline at which distances and tool speeds are imposed; tool accelerations at every
second one."""
_RANK_TOLERANCE = 1e-9
"""Relative size of singular values of equality constraints that count as zero."""
_BASIS = BsplineBasis(SPLINE_ORDER, NUM_CONTROL_POINTS, KnotVectorType.kClampedUniform, 0.0, 1.0)
BASIS_SPLINE = BsplineTrajectory(_BASIS, np.eye(NUM_CONTROL_POINTS))
"""Spline whose values are the basis functions."""
SAMPLE_PARAMETERS = np.linspace(0.0, 1.0, NUM_COLLISION_SAMPLES + 2)[1:-1]
"""Parameters s of the samples. Shape (NUM_COLLISION_SAMPLES,)."""
VALUE_WEIGHTS = BASIS_SPLINE.vector_values(SAMPLE_PARAMETERS).T
"""Maps control points to values at the samples. Shape (NUM_COLLISION_SAMPLES, 28)."""
DERIVATIVE_WEIGHTS = BASIS_SPLINE.MakeDerivative(1).vector_values(SAMPLE_PARAMETERS).T
"""Maps control points to derivatives at the samples. Shape (NUM_COLLISION_SAMPLES, 28)."""
SECOND_DERIVATIVE_WEIGHTS = BASIS_SPLINE.MakeDerivative(2).vector_values(SAMPLE_PARAMETERS).T
"""Maps control points to second derivatives at the samples. Shape (NUM_COLLISION_SAMPLES, 28)."""


@lru_cache(maxsize=16)
def derivative_matrix(order: int, num_joints: int) -> sparse.csr_matrix:
    """Return the matrix from all control points to the control points of a derivative.

    Args:
        order: Order of the derivative.
        num_joints: Number of joints, n.

    Returns:
        Sparse matrix; control points are flattened row by row. Shape ((28 - order) n, 28 n).
    """
    one_joint = np.array(BASIS_SPLINE.MakeDerivative(order).control_points())[..., 0]
    return sparse.csr_matrix(np.kron(one_joint, np.eye(num_joints)))


@dataclass(frozen=True)
class LinearizedDistances:
    """First-order models of signed distances at configurations of a path.

    Attributes:
        rows: Indices of the configurations. Shape (k,).
        gradients: Derivatives by the joint positions [m/rad]. Shape (k, n).
        slack: Distances minus required distances [m]. Shape (k,).
    """

    rows: NDArray[np.int64]
    gradients: Floats
    slack: Floats


class ControlPointSubspaces:
    """Affine subspaces of the control points in which equality constraints hold.

    The control points are p = p_0 + N y. Most variables are eliminated by this: the solver takes
    half the time that it takes with equality constraints.
    """

    def __init__(self, points: Floats) -> None:
        """Start with all control points free but the fixed ones.

        Args:
            points: Previous control points. Shape (28, n).
        """
        self._points = points.copy()
        n = points.shape[1]
        num_free = NUM_CONTROL_POINTS - 2 * NUM_FIXED_CONTROL_POINTS
        fixed = [np.zeros((n, 0))] * NUM_FIXED_CONTROL_POINTS
        self._bases = [*fixed, *([np.eye(n)] * num_free), *fixed]

    def constrain(self, indices: Sequence[int], A: Floats, b: Floats) -> None:
        """Add A q = b for free control points that have no constraint yet.

        Args:
            indices: Indices of the control points.
            A: Coefficients. Shape (m, n).
            b: Right-hand side. Shape (m,).
        """
        basis, inverse = null_space(A, rcond=_RANK_TOLERANCE), np.linalg.pinv(A)
        for index in indices:
            q = self._points[index]
            q += inverse @ (b - A @ q)
            self._bases[index] = basis

    @property
    def offset(self) -> Floats:
        """Offset p_0, flattened row by row. Shape (28 n,)."""
        return self._points.ravel()

    @property
    def basis(self) -> sparse.csr_matrix:
        """Basis N. Shape (28 n, k)."""
        rows, columns = np.cumsum([(0, 0), *(basis.shape for basis in self._bases)], axis=0).T
        basis = np.zeros((rows[-1], columns[-1]))
        for k, of_point in enumerate(self._bases):
            basis[rows[k] : rows[k + 1], columns[k] : columns[k + 1]] = of_point
        return sparse.csr_matrix(basis)


class LinearConstraints:
    """Linear inequalities of the control points p, flattened row by row, and T^2."""

    def __init__(self) -> None:
        self._A_points = list[sparse.csr_matrix]()
        self._A_square = list[Floats]()
        self._b = list[Floats]()

    def add(self, A_points: sparse.csr_matrix, A_square: Floats, b: Floats) -> None:
        """Add A_points p + A_square T^2 <= b.

        Args:
            A_points: Coefficients of p. Shape (m, 28 n).
            A_square: Coefficients of T^2. Shape (m,).
            b: Upper bounds. Shape (m,).
        """
        self._A_points.append(A_points)
        self._A_square.append(A_square)
        self._b.append(b)

    def add_two_sided(
        self, A_points: sparse.csr_matrix, bound: Floats, b: Floats | None = None
    ) -> None:
        """Add -bound T^2 - b <= A_points p <= bound T^2 + b.

        Args:
            A_points: Coefficients of p. Shape (m, 28 n).
            bound: Coefficients of T^2. Shape (m,).
            b: Constant bounds; None for 0. Shape (m,).
        """
        for sign in (1, -1):
            self.add(sign * A_points, -bound, np.zeros_like(bound) if b is None else b)

    def add_distances(self, distances: LinearizedDistances, q: Floats) -> None:
        """Add that distances at samples of the spline are not below the required ones.

        Args:
            distances: Distances, linearized at the previous solution.
            q: Samples of that solution. Shape (NUM_COLLISION_SAMPLES, n).
        """
        index, gradients = distances.rows, distances.gradients
        if not len(index):
            return
        self.add(
            directional_matrix(-VALUE_WEIGHTS[index], gradients),
            np.zeros(len(index)),
            distances.slack - (gradients * q[index]).sum(axis=1),
        )

    def add_to(
        self, prog: MathematicalProgram, subspaces: ControlPointSubspaces, x: NDArray[np.object_]
    ) -> None:
        """Add the constraints to a program with the variables x = (y, T^2)."""
        A_points = sparse.vstack(self._A_points, format="csr")
        A_y = A_points @ subspaces.basis
        b = np.concatenate(self._b) - A_points @ subspaces.offset
        # Rows of fixed control points alone hold at any solution, but for rounding.
        is_kept = np.diff(A_y.indptr) > 0
        A_square = sparse.csr_matrix(np.concatenate(self._A_square)[is_kept, None])
        A = sparse.hstack([A_y[is_kept], A_square], format="csc")
        prog.AddLinearConstraint(A, np.full(A.shape[0], -np.inf), b[is_kept], x)


def directional_matrix(weights: Floats, directions: Floats) -> sparse.csr_matrix:
    """Return the matrix from control points to components of spline values.

    Args:
        weights: Weights of the control points in each value. Shape (m, 28).
        directions: Direction of each component. Shape (m, n).

    Returns:
        Sparse matrix. Shape (m, 28 n).
    """
    return sparse.csr_matrix(
        (weights[:, :, None] * directions[:, None, :]).reshape(len(weights), -1)
    )
