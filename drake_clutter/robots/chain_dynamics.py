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
def _cross(a, b, out):  # type: ignore[no-untyped-def]
    """Write the cross product of vectors a and b (3,) to out."""
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@njit(cache=True, inline="always")
def _relative_motion(w, alpha, r, velocity, acceleration, scratch):  # type: ignore[no-untyped-def]
    """Write velocity and acceleration of a point at r relative to the origin of its body."""
    _cross(w, r, velocity)
    _cross(alpha, r, acceleration)
    _cross(w, velocity, scratch)
    for i in range(3):
        acceleration[i] += scratch[i]


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
    """Write torques (m, n), and velocities and accelerations (m, k, 3) of points p_FC (k, 3)."""
    n = len(revolute)
    frames, moved = np.empty((n + 1, 4, 4)), np.empty((n, 3, 4))
    origin = np.zeros((n + 1, 3))  # of each joint's frame; row n + 1 is that of the base
    force = np.empty((n, 3))
    moment = np.empty((n, 3))  # about the origin of the joint
    lever = np.empty((n, 3))  # mass times its lever about the origin of the joint
    w, alpha, v_o, a_o = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    r, dv, da, scratch, spin = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    w_J, alpha_J, h_J = np.empty(3), np.empty(3), np.empty(3)
    for k in range(len(q)):
        chain_frames(fixed, revolute, q[k], frames, moved)
        for i in range(3):
            w[i] = alpha[i] = v_o[i] = a_o[i] = 0.0
        for j in range(n):
            rotation = moved[j]
            z = rotation[:, 2]
            for i in range(3):
                origin[j, i] = rotation[i, 3]
                r[i] = origin[j, i] - origin[j - 1, i]
            _relative_motion(w, alpha, r, dv, da, scratch)
            _cross(w, z, spin)
            for i in range(3):
                v_o[i] += dv[i]
                a_o[i] += da[i]
                if revolute[j]:
                    alpha[i] += spin[i] * v[k, j] + z[i] * a[k, j]
                    w[i] += z[i] * v[k, j]
                else:
                    a_o[i] += 2 * spin[i] * v[k, j] + z[i] * a[k, j]
                    v_o[i] += z[i] * v[k, j]
            for i in range(3):
                r[i] = w_J[i] = alpha_J[i] = 0.0
                for x in range(3):
                    r[i] += rotation[i, x] * p_JCm[j, x]
                    w_J[i] += rotation[x, i] * w[x]
                    alpha_J[i] += rotation[x, i] * alpha[x]
            _relative_motion(w, alpha, r, dv, da, scratch)
            for i in range(3):
                force[j, i] = masses[j] * (a_o[i] + da[i])
                lever[j, i] = masses[j] * r[i]
                h_J[i] = 0.0
                for x in range(3):
                    h_J[i] += inertias[j, i, x] * w_J[x]
            _cross(w_J, h_J, spin)  # moment of inertia in J, first its gyroscopic part
            for i in range(3):
                for x in range(3):
                    spin[i] += inertias[j, i, x] * alpha_J[x]
            _cross(r, force[j], moment[j])
            for i in range(3):
                for x in range(3):
                    moment[j, i] += rotation[i, x] * spin[x]
        for point in range(len(p_FC)):
            for i in range(3):
                r[i] = frames[n, i, 3] - origin[n - 1, i]
                for x in range(3):
                    r[i] += frames[n, i, x] * p_FC[point, x]
            _relative_motion(w, alpha, r, dv, da, scratch)
            for i in range(3):
                velocities[k, point, i] = v_o[i] + dv[i]
                accelerations[k, point, i] = a_o[i] + da[i]
        mass = 0.0
        for j in range(n - 1, -1, -1):
            if j < n - 1:
                for i in range(3):
                    r[i] = origin[j + 1, i] - origin[j, i]
                _cross(r, force[j + 1], scratch)
                for i in range(3):
                    force[j, i] += force[j + 1, i]
                    moment[j, i] += moment[j + 1, i] + scratch[i]
                    lever[j, i] += lever[j + 1, i] + mass * r[i]
            mass += masses[j]
            _cross(gravity, lever[j], scratch)
            dynamic[k, j] = gravitational[k, j] = 0.0
            for i in range(3):
                z_i = frames[j, i, 2]
                dynamic[k, j] += z_i * (moment[j, i] if revolute[j] else force[j, i])
                gravitational[k, j] += z_i * (scratch[i] if revolute[j] else -mass * gravity[i])
