"""Non-negative least squares for compiled loops (Lawson and Hanson, Solving Least Squares Problems, ch. 23).

SciPy's solver cannot be called from them; tests hold this one against it.
"""

import numpy as np
from numba import njit


@njit(cache=True)
def nnls(A, b, tolerance):  # type: ignore[no-untyped-def]
    """x >= 0, (columns,), that minimises |A x - b|, by active sets on the normal equations.

    Args:
        A: (rows, columns).
        b: (rows,).
        tolerance: slopes of the squared residual below this are taken for zero.
    """
    rows, columns = A.shape
    G, c = A.T @ A, A.T @ b
    x, chosen = np.zeros(columns), np.zeros(columns, np.bool_)
    blocked = np.zeros(columns, np.bool_)
    for _ in range(6 * rows + 30):
        w = c - G @ x
        entering, most = -1, tolerance
        for k in range(columns):
            if not chosen[k] and not blocked[k] and w[k] > most:
                entering, most = k, w[k]
        if entering < 0:
            break
        chosen[entering] = True
        while True:
            members = np.nonzero(chosen)[0]
            m = len(members)
            # Cholesky, in place; a column that depends on the others is left out.
            L, s = np.empty((m, m)), np.empty(m)
            dependent = -1
            for r in range(m):
                for q in range(r + 1):
                    value = G[members[r], members[q]]
                    for t in range(q):
                        value -= L[r, t] * L[q, t]
                    if r == q:
                        if value < 1e-11:
                            dependent = r
                            break
                        L[r, r] = np.sqrt(value)
                    else:
                        L[r, q] = value / L[q, q]
                if dependent >= 0:
                    break
            if dependent >= 0:
                chosen[entering] = False
                x[entering] = 0.0
                blocked[entering] = True
                break
            for r in range(m):
                value = c[members[r]]
                for t in range(r):
                    value -= L[r, t] * s[t]
                s[r] = value / L[r, r]
            for r in range(m - 1, -1, -1):
                value = s[r]
                for t in range(r + 1, m):
                    value -= L[t, r] * s[t]
                s[r] = value / L[r, r]
            step = 1.0
            for r in range(m):
                if s[r] < 0:
                    step = min(step, x[members[r]] / (x[members[r]] - s[r]))
            for r in range(m):
                x[members[r]] += step * (s[r] - x[members[r]])
            if step >= 1.0:
                blocked[:] = False
                break
            for r in range(m):
                if x[members[r]] <= 1e-12:
                    x[members[r]] = 0.0
                    chosen[members[r]] = False
    return x
