"""An arm as a geometrically exact rod: bending, torsion, shear and extension, with fibres along it.

This mechanics is independent of training's: no links, hinges or tendons. The rod is cut into elements of
constant strain: curvature and twist kappa, shear and extension nu, both in the element's own axes. h is the
length of an element, R_e are the axes at its beginning (turned by the joint at the beginning of a section),
and exp is the rotation by a vector:

    R_{e+1} = R_e exp(h kappa),    x_{e+1} = x_e + h R_e exp(h kappa / 2) nu,

At rest nu = (0, 0, -1), because the arm extends along -z of its base. Chambers and springs are fibres glued
to the cross-sections, and each piece stretches by itself: a piece at r has the length h |nu + kappa x r|.
lambda is this length divided by h, times the section's length L. With d = lambda - rest length and s = d / L,
a chamber pulls with

    f = k d (1 + b s + c s^2) - p (1 + g p) (A + A' (lambda - L)).

It hardens with c, unlike in stretch and compression with b, and its effective area grows with pressure by g.
The motion is overdamped, without inertia: C dq/dt = -dV/dq, with the potential V and the
damping C in proportion to the stiffness of the straight rod. A step is a linearly implicit Euler step. At
rest dV/dq is zero for every step size.

Source: Simo, "A finite strain beam formulation", Comput. Methods Appl. Mech. Eng. 49 (1985); elements of
constant strain as in Renda et al., "Discrete Cosserat approach", IEEE T-RO 34 (2018).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from mjx_softarm.sensing.pose import rotation_about

GRAVITY_M_S2 = 9.81
N_STRAINS = 6  # strains of an element: curvature x, y, twist [1/m], shear x, y, extension
REST_STRAIN = np.array([0.0, 0.0, 0.0, 0.0, 0.0, -1.0])
CREEP_S = 0.25  # time constant of the damping
LONGEST_S = 400.0  # longest step on the way to rest
SETTLE_STEPS = 200  # largest number of these steps
REST_TOLERANCE = 1e-9  # largest entry of dV/dq at rest [N m^2, N m]
_CROSS = np.zeros((3, 9))  # maps a vector to the matrix of its cross product
_CROSS[0, [5, 7]] = _CROSS[1, [6, 2]] = _CROSS[2, [1, 3]] = -1.0, 1.0


class RodParts(NamedTuple):
    """Numbers of a rod of s sections with c chambers and k springs each."""

    section_length_m: np.ndarray  # (s,)
    section_mass_kg: np.ndarray  # (s,)
    bending: np.ndarray  # (s,) E I [N m^2]
    torsion: np.ndarray  # (s,) G J [N m^2]
    shear: np.ndarray  # (s,) G A [N]
    extension: np.ndarray  # (s,) E A [N]
    joint: np.ndarray  # (s, 3, 3) turn of each section against the end of the section above
    chamber_hole_m: np.ndarray  # (s, c, 2) x and y in the cross-sections
    spring_hole_m: np.ndarray  # (s, k, 2) x and y in the cross-sections
    stiffness: np.ndarray  # (s, c) [N/m] of the chambers
    hardening: np.ndarray  # (s, c) share by which a chamber is stiffer at a section's length from rest
    skew: np.ndarray  # (s, c) b, positive where a chamber is stiffer in stretch than in compression
    rest_m: np.ndarray  # (s, c) rest lengths of the chambers
    area: np.ndarray  # (s, c) A [N/kPa] at the section's length
    area_slope: np.ndarray  # (s, c) A' [N/kPa/m]
    area_growth: np.ndarray  # (s, c) g [1/kPa], growth of the area with pressure
    spring_stiffness: np.ndarray  # (s,) [N/m]
    spring_rest_m: np.ndarray  # (s,)
    tool_mass_kg: np.ndarray  # (2,) gripper and payload
    tool_offset_m: np.ndarray  # (2,) distances of gripper and payload below the rod's end
    up: np.ndarray  # (3,) direction against gravity, in the axes of the rod's base


class Shape(NamedTuple):
    """Cross-sections at the ends of the elements, in the axes of the base; the first is the base."""

    node_m: np.ndarray  # (n + 1, 3) centres
    rotation: np.ndarray  # (n + 1, 3, 3) rotations, whose columns are the axes


class Rod:
    """A rod with its strains `q` (n, 6), its only state; masses of the tool in `parts` may be replaced."""

    def __init__(self, parts: RodParts, per_section: int):
        """Make a straight rod without force, with `per_section` elements in each section."""

        def each(value: np.ndarray) -> np.ndarray:
            """Return numbers of the sections (s, ...) for each of their elements (n, m)."""
            return np.repeat(value.reshape(len(parts.bending), -1), per_section, axis=0)

        # Joints and elasticity of each element.
        self.parts = parts
        self.per_section = per_section
        self.length_m = each(parts.section_length_m / per_section)  # (n, 1)
        n_sections, n_chambers = parts.stiffness.shape
        self._joint = np.tile(np.eye(3), (n_sections * per_section, 1, 1))
        self._joint[::per_section] = parts.joint
        law = [parts.bending, parts.bending, parts.torsion, parts.shear, parts.shear, parts.extension]
        self._elastic = np.repeat(np.stack(law, axis=1), per_section, axis=0)  # (n, 6)
        # Places of the fibres, and their constant derivatives.
        hole = np.concatenate([parts.chamber_hole_m, parts.spring_hole_m], axis=1)
        hole = np.repeat(np.pad(hole, ((0, 0), (0, 0), (0, 1))), per_section, axis=0)
        # d(nu + kappa x r) / dq (n, c + k fibres, 3, 6 strains)
        self._along = np.concatenate([-_cross_matrix(hole), np.broadcast_to(np.eye(3), (*hole.shape, 3))], -1)
        self._square = np.swapaxes(self._along, -1, -2) @ self._along
        # Laws of the fibres, and masses.
        self._section_m = each(parts.section_length_m)
        chambers = parts.stiffness, parts.skew, parts.hardening, parts.rest_m, parts.area, parts.area_slope
        self._chamber_law = [each(value) for value in chambers]
        self._growth = each(parts.area_growth)
        self._spring_law = each(parts.spring_stiffness), each(parts.spring_rest_m)
        mass = each(parts.section_mass_kg / per_section)[:, 0]
        self._node_kg = 0.5 * (mass + np.append(mass[1:], 0.0))  # (n,) lumped at the lower ends
        # Rest state and damping.
        self.q = np.tile(REST_STRAIN, (n_sections * per_section, 1))
        stiffness = self._local(self.q, np.zeros((n_sections, n_chambers)))[1]
        self.damping = CREEP_S * np.diagonal(stiffness, axis1=1, axis2=2).ravel()

    def shape(self) -> Shape:
        """Return the rod's cross-sections."""
        return self._shape()[0]

    def chamber_lengths(self) -> np.ndarray:
        """Return the lengths (s c,) [m] of the chambers."""
        return self._fibre_lengths(slice(None, self.parts.stiffness.shape[1]))

    def spring_lengths(self) -> np.ndarray:
        """Return the lengths (s k,) [m] of the springs."""
        return self._fibre_lengths(slice(self.parts.stiffness.shape[1], None))

    def _fibre_lengths(self, fibres: slice) -> np.ndarray:
        """Return the lengths (s m,) [m] of m fibres of each section."""
        pieces = self.length_m * np.linalg.norm(self._stretch(self.q)[:, fibres], axis=-1)
        return pieces.reshape(-1, self.per_section, pieces.shape[1]).sum(axis=1).ravel()

    def step(self, pressure_kpa: np.ndarray, duration_s: float) -> float:
        """Take a step at pressures (s c,) [kPa]; return the largest entry of dV/dq before the step."""
        gradient, hessian = self._derivatives(pressure_kpa.reshape(self.parts.stiffness.shape))
        factor = None
        while factor is None:
            np.fill_diagonal(hessian, hessian.diagonal() + self.damping / duration_s)
            try:
                factor = cho_factor(hessian, check_finite=False)
            except LinAlgError:  # the potential is not convex here: take a shorter step
                duration_s *= 0.5
        change = cho_solve(factor, gradient.ravel(), check_finite=False)
        self.q = self.q - change.reshape(self.q.shape)
        return float(np.abs(gradient).max())

    def settle(self, pressure_kpa: np.ndarray) -> None:
        """Move to rest at pressures (s c,) [kPa], through some seconds of motion.

        Raises:
            FloatingPointError: the rod does not come to rest.
        """
        left = np.inf
        for k in range(SETTLE_STEPS):
            left = self.step(pressure_kpa, min(0.1 * 2.0**k, LONGEST_S))
            if left < REST_TOLERANCE:
                return
        got = f"a force of {left:.2g} N m^2 or N m after {SETTLE_STEPS} steps"
        raise FloatingPointError(f"rod: got {got}, expected under {REST_TOLERANCE:g}")

    def _shape(self) -> tuple[Shape, np.ndarray, np.ndarray]:
        """Return the shape, and the axes (n, 3, 3) at the beginning and in the middle of each element."""
        half, turn = (rotation_about(share * self.length_m * self.q[:, :3]) for share in (0.5, 1.0))
        rotation = [np.eye(3)]
        begin = []
        for joint, own in zip(self._joint, turn, strict=True):
            begin.append(rotation[-1] @ joint)
            rotation.append(begin[-1] @ own)
        begin = np.array(begin)
        middle = begin @ half
        reach = self.length_m * (middle @ self.q[:, 3:, None])[..., 0]
        node = np.concatenate([np.zeros((1, 3)), np.cumsum(reach, axis=0)])
        return Shape(node, np.array(rotation)), begin, middle

    def _stretch(self, q: np.ndarray) -> np.ndarray:
        """Return nu + kappa x r (n, c + k fibres, 3)."""
        return (self._along @ q[:, None, :, None])[..., 0]

    def _local(self, q: np.ndarray, pressure_kpa: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return derivatives of the energy of backbone, chambers and springs: (n, 6) and (n, 6, 6)."""
        # Stretch of the fibres, their pulls and the pulls' slopes, each (n, c + k)
        h = self.length_m
        u = self._stretch(q)
        size = np.sqrt(np.sum(u**2, axis=-1))
        tension, slope = self._fibres(self._section_m * size, pressure_kpa)

        # Derivatives of fibres, then of the backbone
        lead = (np.swapaxes(self._along, -1, -2) @ (u / size[..., None])[..., None])[..., 0]  # (n, c + k, 6)
        gradient = h * np.sum(tension[..., None] * lead, axis=1)
        gradient += h * self._elastic * (q - REST_STRAIN)
        curve = h * tension / size
        weight = h * self._section_m * slope - curve
        hessian = np.swapaxes(lead, 1, 2) @ (weight[..., None] * lead)
        hessian += np.sum(curve[..., None, None] * self._square, axis=1)
        hessian += h[..., None] * self._elastic[..., None] * np.eye(N_STRAINS)
        return gradient, hessian

    def _fibres(self, length_m: np.ndarray, pressure_kpa: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return pulls (n, c + k) [N] of fibres with these lengths (n, c + k), and their slopes [N/m]."""
        n_chambers = self.parts.stiffness.shape[1]
        full_m = self._section_m
        chamber, spring = length_m[:, :n_chambers], length_m[:, n_chambers:]
        stiffness, skew, hardening, rest, area, area_slope = self._chamber_law
        spring_stiffness, spring_rest = self._spring_law
        kpa = np.repeat(pressure_kpa, self.per_section, axis=0)
        kpa = kpa * (1.0 + self._growth * kpa)  # pressure of the same force on a constant area

        # Chambers, then springs
        off = chamber - rest
        skewed, harder = skew * off / full_m, hardening * (off / full_m) ** 2
        pull = stiffness * off * (1.0 + skewed + harder) - kpa * (area + area_slope * (chamber - full_m))
        slope = stiffness * (1.0 + 2.0 * skewed + 3.0 * harder) - kpa * area_slope
        drawn = spring_stiffness * (spring - spring_rest)
        constant = np.broadcast_to(spring_stiffness, spring.shape)
        return np.concatenate([pull, drawn], -1), np.concatenate([slope, constant], -1)

    def _derivatives(self, pressure_kpa: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return dV/dq (n, 6) and its derivative (6 n, 6 n) at pressures (s, c)."""
        gradient, local = self._local(self.q, pressure_kpa)
        fall, turn = self._weights()
        up = GRAVITY_M_S2 * self.parts.up
        # Gravity between two elements: d2V / dq_i dq_j = up . (turn_i x fall_j), with i nearer to the base.
        n = len(self.q)
        lever = np.cross(up, turn).reshape(n * N_STRAINS, 3)
        matrix = (lever @ fall.reshape(-1, 3).T).reshape(n, N_STRAINS, n, N_STRAINS)
        matrix *= np.triu(np.ones((n, n)))[:, None, :, None]
        # Make the matrix symmetric, and add the elements' diagonal stiffness.
        diagonal = np.arange(n)
        matrix[diagonal, :, diagonal] *= 0.5
        matrix = matrix.reshape(n * N_STRAINS, -1)
        matrix = (matrix + matrix.T).reshape(n, N_STRAINS, n, N_STRAINS)
        matrix[diagonal, :, diagonal] += local
        return gradient + fall @ up, matrix.reshape(n * N_STRAINS, -1)

    def _weights(self) -> tuple[np.ndarray, np.ndarray]:
        """Return derivatives (n, 6, 3) by the strains: moment of all masses [kg m], and rotation.

        The rotation is that of the cross-sections below the element.
        """
        # Places of the masses, and the moment of all masses below each element.
        h = self.length_m
        parts = self.parts
        bend = self.q[:, :3]
        (node, rotation), begin, middle = self._shape()
        tool = node[-1] - parts.tool_offset_m[:, None] * rotation[-1, :, 2]
        below = self._node_kg[:, None] * node[1:]
        moment = np.cumsum(below[::-1], axis=0)[::-1] + parts.tool_mass_kg @ tool
        mass = np.cumsum(self._node_kg[::-1])[::-1] + parts.tool_mass_kg.sum()
        hung = moment - mass[:, None] * node[1:]
        # Turns of the part below an element, and shifts of its lower end.
        h3 = h[..., None]
        whole = h3 * np.swapaxes(begin @ _left_jacobian(h * bend), 1, 2)  # (n, 3 strains, 3)
        inner = 0.5 * h3 * np.swapaxes(begin @ _left_jacobian(0.5 * h * bend), 1, 2)
        reach = np.diff(node, axis=0)
        aside = np.concatenate([np.cross(inner, reach[:, None]), h3 * np.swapaxes(middle, 1, 2)], axis=1)
        turns = np.concatenate([whole, np.zeros_like(whole)], axis=1)
        return mass[:, None, None] * aside + np.cross(turns, hung[:, None]), turns


def _cross_matrix(v: np.ndarray) -> np.ndarray:
    """Return matrices (..., 3, 3) that multiply from the left as the cross product with v (..., 3)."""
    return (v @ _CROSS).reshape(*v.shape, 3)


def _left_jacobian(v: np.ndarray) -> np.ndarray:
    """Return J (..., 3, 3) with exp(v + dv) = exp(J dv) exp(v), to first order."""
    angle = np.linalg.norm(v, axis=-1)[..., None, None]
    small = angle < 1e-3
    safe = np.where(small, 1.0, angle)
    third = np.where(small, 1.0 / 6.0, (safe - np.sin(safe)) / safe**3)
    cross = _cross_matrix(v)
    return np.eye(3) + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * cross + third * cross @ cross
