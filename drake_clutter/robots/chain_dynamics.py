"""Inverse dynamics of serial arms and motion of points on the last link, compiled.

Source: recursive Newton-Euler algorithm, Featherstone 2008, "Rigid Body Dynamics Algorithms",
chapter 5, with all vectors in the base frame. Frames: B is the robot's base, F is its flange, J is
the frame of a joint with its own motion, z along the axis, C is a point that is fixed in F.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_clutter.compilation import njit
from drake_clutter.robots.serial_chain import SerialChain, chain_frames

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class ChainMotion:
    """Torques of a motion and the motion of points.

    Attributes:
        dynamic_torques: Joint torques without those of gravity [N m]. Shape (m, n).
        gravity_torques: Joint torques that hold the arm at rest [N m]. Shape (m, n).
        velocities: Velocities of the points in B [m/s]. Shape (m, k, 3).
        accelerations: Accelerations of the points in B [m/s^2]. Shape (m, k, 3).
    """

    dynamic_torques: Floats
    gravity_torques: Floats
    velocities: Floats
    accelerations: Floats


@dataclass(frozen=True, eq=False)
class ChainDynamics:
    """Masses of a serial arm, lumped to one rigid body for each joint.

    Attributes:
        chain: Kinematic chain.
        gravity: Gravitational acceleration in B [m/s^2]. Shape (3,).
        masses: Masses [kg]. Shape (n,).
        p_JCm: Centers of mass in their joint frames [m]. Shape (n, 3).
        inertias: Rotational inertias about the centers of mass in the joint frames [kg m^2]. Shape
            (n, 3, 3).
        damping: Viscous friction of the joints [N m s/rad]. Shape (n,).
        rotor_inertias: Reflected inertias of the rotors [kg m^2]. Shape (n,).
    """

    chain: SerialChain
    gravity: Floats
    masses: Floats
    p_JCm: Floats
    inertias: Floats
    damping: Floats
    rotor_inertias: Floats

    def inverse_dynamics(self, q: Floats, v: Floats, a: Floats) -> Floats:
        """Return the joint torques of a motion [N m]. Shape (m, n).

        Args:
            q: Positions [rad]. Shape (m, n).
            v: Velocities [rad/s]. Shape (m, n).
            a: Accelerations [rad/s^2]. Shape (m, n).
        """
        motion = self.motion(q, v, a, np.zeros((0, 3)))
        return motion.dynamic_torques + motion.gravity_torques

    def motion(self, q: Floats, v: Floats, a: Floats, p_FC: Floats) -> ChainMotion:
        """Return joint torques and the motion of points that are fixed in the flange.

        Args:
            q: Positions [rad]. Shape (m, n).
            v: Velocities [rad/s]. Shape (m, n).
            a: Accelerations [rad/s^2]. Shape (m, n).
            p_FC: Points [m]. Shape (k, 3).
        """
        dynamic, gravity = np.empty(q.shape), np.empty(q.shape)
        velocities, accelerations = (np.empty((len(q), len(p_FC), 3)) for _ in range(2))
        _calc_motion(
            self.chain.fixed,
            self.chain.revolute,
            self.gravity,
            self.masses,
            self.p_JCm,
            self.inertias,
            np.ascontiguousarray(q, float),
            np.ascontiguousarray(v, float),
            np.ascontiguousarray(a, float),
            np.ascontiguousarray(p_FC, float),
            dynamic,
            gravity,
            velocities,
            accelerations,
        )
        dynamic += self.damping * v + self.rotor_inertias * a
        return ChainMotion(dynamic, gravity, velocities, accelerations)


@njit(cache=True, inline="always")
def _cross(a, b):  # type: ignore[no-untyped-def]
    """Return the cross product of two vectors."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(cache=True, inline="always")
def _add(a, b):  # type: ignore[no-untyped-def]
    """Return the sum of two vectors."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@njit(cache=True, inline="always")
def _subtract(a, b):  # type: ignore[no-untyped-def]
    """Return the difference of two vectors."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@njit(cache=True, inline="always")
def _scale(factor, a):  # type: ignore[no-untyped-def]
    """Return a vector times a factor."""
    return factor * a[0], factor * a[1], factor * a[2]


@njit(cache=True, inline="always")
def _add_rotated(first, R, a):  # type: ignore[no-untyped-def]
    """Return first + R a, of the left three columns of R."""
    return (
        first[0] + R[0, 0] * a[0] + R[0, 1] * a[1] + R[0, 2] * a[2],
        first[1] + R[1, 0] * a[0] + R[1, 1] * a[1] + R[1, 2] * a[2],
        first[2] + R[2, 0] * a[0] + R[2, 1] * a[1] + R[2, 2] * a[2],
    )


@njit(cache=True, inline="always")
def _rotate_back(R, a):  # type: ignore[no-untyped-def]
    """Return R^T a, of the left three columns of R."""
    return (
        R[0, 0] * a[0] + R[1, 0] * a[1] + R[2, 0] * a[2],
        R[0, 1] * a[0] + R[1, 1] * a[1] + R[2, 1] * a[2],
        R[0, 2] * a[0] + R[1, 2] * a[1] + R[2, 2] * a[2],
    )


@njit(cache=True, inline="always")
def _relative_motion(w, alpha, r):  # type: ignore[no-untyped-def]
    """Return velocity and acceleration of a point at r relative to the origin of its body."""
    velocity = _cross(w, r)
    return velocity, _add(_cross(alpha, r), _cross(w, velocity))


@njit(cache=True, nogil=True)
def _calc_motion(  # type: ignore[no-untyped-def]
    fixed,
    revolute,
    gravity,
    masses,
    p_JCm,
    inertias,
    q,
    v,
    a,
    p_FC,
    dynamic,
    gravitational,
    velocities,
    accelerations,
):
    """Write torques (m, n), and velocities and accelerations (m, k, 3) of points p_FC (k, 3).

    Vectors are tuples, which the compiler keeps in registers.
    """
    n = len(revolute)
    frames, moved = np.empty((n + 1, 4, 4)), np.empty((n, 3, 4))
    forces = np.empty((n, 3))
    moments = np.empty((n, 3))  # about the origin of the joint
    levers = np.empty((n, 3))  # mass times its lever about the origin of the joint
    zero = 0.0, 0.0, 0.0
    g = gravity[0], gravity[1], gravity[2]
    for k in range(len(q)):
        chain_frames(fixed, revolute, q[k], frames, moved)
        w = alpha = v_o = a_o = origin = zero
        for j in range(n):
            R = moved[j]
            z = R[0, 2], R[1, 2], R[2, 2]
            p = R[0, 3], R[1, 3], R[2, 3]
            dv, da = _relative_motion(w, alpha, _subtract(p, origin))
            origin = p
            spin = _cross(w, z)
            v_o, a_o = _add(v_o, dv), _add(a_o, da)
            if revolute[j]:
                alpha = _add(alpha, _add(_scale(v[k, j], spin), _scale(a[k, j], z)))
                w = _add(w, _scale(v[k, j], z))
            else:
                a_o = _add(a_o, _add(_scale(2 * v[k, j], spin), _scale(a[k, j], z)))
                v_o = _add(v_o, _scale(v[k, j], z))
            r = _add_rotated(zero, R, (p_JCm[j, 0], p_JCm[j, 1], p_JCm[j, 2]))
            _, da = _relative_motion(w, alpha, r)
            force = _scale(masses[j], _add(a_o, da))
            w_J, alpha_J = _rotate_back(R, w), _rotate_back(R, alpha)
            # Moment of inertia in J: its gyroscopic part and that of the angular acceleration.
            h_J = _add_rotated(zero, inertias[j], w_J)
            spin = _add_rotated(_cross(w_J, h_J), inertias[j], alpha_J)
            moment = _add_rotated(_cross(r, force), R, spin)
            for i in range(3):
                forces[j, i] = force[i]
                moments[j, i] = moment[i]
                levers[j, i] = masses[j] * r[i]
        X = frames[n]
        for point in range(len(p_FC)):
            p = p_FC[point, 0], p_FC[point, 1], p_FC[point, 2]
            r = _add_rotated(_subtract((X[0, 3], X[1, 3], X[2, 3]), origin), X, p)
            dv, da = _relative_motion(w, alpha, r)
            for i in range(3):
                velocities[k, point, i] = v_o[i] + dv[i]
                accelerations[k, point, i] = a_o[i] + da[i]
        force = moment = lever = zero
        mass = 0.0
        origin = moved[n - 1, 0, 3], moved[n - 1, 1, 3], moved[n - 1, 2, 3]
        for j in range(n - 1, -1, -1):
            R = moved[j]
            p = R[0, 3], R[1, 3], R[2, 3]
            r = _subtract(origin, p)
            origin = p
            own = moments[j, 0], moments[j, 1], moments[j, 2]
            moment = _add(own, _add(moment, _cross(r, force)))
            lever = _add((levers[j, 0], levers[j, 1], levers[j, 2]), _add(lever, _scale(mass, r)))
            force = _add((forces[j, 0], forces[j, 1], forces[j, 2]), force)
            mass += masses[j]
            z = frames[j, 0, 2], frames[j, 1, 2], frames[j, 2, 2]
            turning = _cross(g, lever)
            along = moment if revolute[j] else force
            held = turning if revolute[j] else _scale(-mass, g)
            dynamic[k, j] = z[0] * along[0] + z[1] * along[1] + z[2] * along[2]
            gravitational[k, j] = z[0] * held[0] + z[1] * held[1] + z[2] * held[2]
