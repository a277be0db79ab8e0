"""Non-negative least squares for functions compiled by numba.

Algorithm NNLS of Lawson and Hanson, "Solving Least Squares Problems" (1974), chapter 23. SciPy's
solver cannot be called from compiled functions; the tests compare the two.
"""

import numpy as np

from drake_clutter.compilation import njit


@njit(cache=True, fastmath={"reassoc"})
def _dot(a, b, count):  # type: ignore[no-untyped-def]
    """Return the dot product of the first elements of two vectors."""
    total = 0.0
    for k in range(count):
        total += a[k] * b[k]
    return total


@njit(cache=True)
def _factor_row(A, members, m, L):  # type: ignore[no-untyped-def]
    """Write row m of the Cholesky factor of the members' normal equations.

    Returns:
        False if the member depends linearly on those before it.
    """
    newest = A[members[m]]
    for q in range(m):
        L[m, q] = (_dot(newest, A[members[q]], len(newest)) - _dot(L[m], L[q], q)) / L[q, q]
    pivot = _dot(newest, newest, len(newest)) - _dot(L[m], L[m], m)
    L[m, m] = np.sqrt(max(pivot, 1e-11))
    return pivot > 1e-11


@njit(cache=True)
def nnls(A, b, tolerance):  # type: ignore[no-untyped-def]
    """Return the x >= 0 that minimizes |A^T x - b|, by an active-set method.

    The unconstrained problems of the active set are solved by the normal equations.

    Args:
        A: The transposed matrix, so that a column is contiguous. Shape (columns, rows).
        b: Right-hand side. Shape (rows,).
        tolerance: Slopes of the squared residual below this count as zero.

    Returns:
        x, shape (columns,), and the residual b - A^T x, shape (rows,).
    """
    columns, rows = A.shape
    x, residual = np.zeros(columns), b.copy()
    is_member, blocked = np.zeros(columns, np.bool_), np.zeros(columns, np.bool_)
    max_members = min(columns, rows) + 1
    members, m = np.empty(max_members, np.int64), 0
    L, c, s = np.empty((max_members, max_members)), np.empty(max_members), np.empty(max_members)
    for _ in range(6 * rows + 30):
        entering, steepest = -1, tolerance
        for k in range(columns):
            if not is_member[k] and not blocked[k]:
                slope = _dot(A[k], residual, rows)
                if slope > steepest:
                    entering, steepest = k, slope
        if entering < 0:
            break
        members[m] = entering
        if m + 1 == max_members or not _factor_row(A, members, m, L):
            blocked[entering] = True
            continue
        is_member[entering] = True
        c[m] = _dot(A[entering], b, rows)
        m += 1
        while True:
            for r in range(m):
                s[r] = (c[r] - _dot(L[r], s, r)) / L[r, r]
            for r in range(m - 1, -1, -1):
                for t in range(r + 1, m):
                    s[r] -= L[t, r] * s[t]
                s[r] /= L[r, r]
            step = 1.0
            for r in range(m):
                if s[r] < 0:
                    step = min(step, x[members[r]] / (x[members[r]] - s[r]))
            kept = 0
            for r in range(m):
                k = members[r]
                x[k] += step * (s[r] - x[k])
                if step < 1.0 and x[k] <= 1e-12:
                    x[k], is_member[k] = 0.0, False
                    continue
                members[kept], c[kept] = k, c[r]
                if kept < r:
                    _factor_row(A, members, kept, L)
                kept += 1
            m = kept
            if step >= 1.0:
                blocked[:] = False
                break
        residual[:] = b
        for r in range(m):
            residual -= x[members[r]] * A[members[r]]
    return x, residual
