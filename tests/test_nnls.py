"""Non-negative least squares against the conditions of an optimum, and against SciPy."""

import numpy as np
import pytest
from conftest import rng
from numpy.typing import NDArray
from scipy.optimize import nnls as scipy_nnls

from drake_clutter.stability.nnls import nnls


def optimal(A: NDArray[np.float64], b: NDArray[np.float64], x: NDArray[np.float64]) -> bool:
    """Assert the Karush-Kuhn-Tucker conditions of non-negative least squares."""
    gradient = A.T @ (b - A @ x)
    return bool((x >= 0).all() and gradient.max() < 1e-8 and np.abs(gradient * x).max() < 1e-8)


@pytest.mark.parametrize(
    "kind", ["full rank", "low rank", "twin columns", "small whole numbers", "one direction"]
)
@pytest.mark.parametrize("within_reach", [True, False])
def test_nnls(kind: str, within_reach: bool) -> None:
    """The residual is as small as SciPy's.

    Cases in which SciPy's solution exceeds 1e13 (of low rank) are skipped.
    """
    generator = rng(0)
    compared = 0
    for _ in range(150):
        rows, columns = int(generator.integers(1, 25)), int(generator.integers(1, 60))
        A = generator.standard_normal((rows, columns))
        if kind == "low rank":
            rank = max(1, min(rows, columns) // 2)
            A = generator.standard_normal((rows, rank)) @ generator.standard_normal((rank, columns))
        elif kind == "twin columns":
            A[:, generator.integers(columns, size=columns // 2)] = A[
                :, generator.integers(columns, size=columns // 2)
            ]
        elif kind == "small whole numbers":
            A = np.round(A)
        elif kind == "one direction":
            A += 3 * generator.standard_normal((rows, 1))
        b = (
            A @ np.maximum(generator.standard_normal(columns), 0)
            if within_reach
            else generator.standard_normal(rows)
        )
        b /= max(1.0, float(np.linalg.norm(b)))
        x, rest = nnls(np.ascontiguousarray(A.T), b, 1e-9)
        np.testing.assert_allclose(rest, b - A @ x, atol=1e-9)
        assert optimal(A, b, x)
        theirs, residual = scipy_nnls(A, b, maxiter=3000)
        if theirs.max() < 1e6:
            compared += 1
            assert np.linalg.norm(A @ x - b) == pytest.approx(residual, abs=1e-8)
    assert compared > 140
