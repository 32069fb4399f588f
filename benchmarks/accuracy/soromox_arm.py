"""An arm whose rod is a robot of SoRoMoX: the driver `Arm`.

Kinematics, inertia, gravity and the backbone's elasticity are SoRoMoX's, of piecewise constant strains.
Chambers and springs are fibres along it, with the energies of `mjx_softarm.twin.rod`; gripper and payload are
masses below its end. All else is of `twin:rod:0`. It runs in SoRoMoX's own environment.

    PYTHON -m mjx_softarm.deploy measure POLICY --arm benchmarks.accuracy.soromox_arm:Arm --out FOLDER
    PYTHON -m benchmarks.accuracy.soromox_arm SEED N    tips beside those of a rod twin, at N random pressures

Source: SoRoMoX, https://github.com/tud-phi/soromox.
"""

from __future__ import annotations

import functools
import json
import math
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_softarm.mechanics.excitation import random_pressures
from mjx_softarm.spec import ArmSpec
from mjx_softarm.twin.instruments import AS_BUILT
from mjx_softarm.twin.rod import (
    CREEP_S,
    GRAVITY_M_S2,
    LONGEST_S,
    REST_TOLERANCE,
    SETTLE_STEPS,
    RodParts,
    Shape,
)
from mjx_softarm.twin.rod_twin import RodTwin

PER_SECTION = 3  # segments of constant strain in a section; markers are at their ends
N_GAUSS_POINTS = 2  # of a segment, for speed
RADIUS_M = 0.06  # of the segments, for their rotary inertia
# SoRoMoX's arm extends along its x; columns are its axes in the axes of this project's base.
_AXES = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])


class SoromoxRod:
    """A rod with the interface of `mjx_softarm.twin.rod.Rod`, with SoRoMoX's mechanics and inertia."""

    def __init__(self, parts: RodParts, per_section: int):
        """Make a straight rod without force, with `per_section` segments in each section."""
        jax.config.update("jax_enable_x64", True)  # in single precision the arm does not come to rest
        # Segments; a section's roll turns its fibres, not its segments
        self.parts, self.per_section = parts, per_section
        n_sections, n_chambers = parts.stiffness.shape
        self._roll = np.array([functools.reduce(np.matmul, parts.joint[: k + 1]) for k in range(n_sections)])
        hole_m = np.concatenate([parts.chamber_hole_m, parts.spring_hole_m], axis=1)
        hole_m = np.pad(hole_m, ((0, 0), (0, 0), (0, 1))) @ np.swapaxes(self._roll, 1, 2) @ _AXES
        segment_m = np.repeat(parts.section_length_m / per_section, per_section)
        self._end_m = np.concatenate([[0.0], np.cumsum(segment_m)])
        self._robot = robot = robot_of(parts, per_section)

        # Energy of all parts
        def stretch(q: Array) -> Array:
            """Return lengths (s, per_section, c + k) of the fibres, divided by that of their segment."""
            angular, linear = jnp.split(robot.strain(q).reshape(n_sections, per_section, 1, 6), 2, axis=-1)
            return jnp.linalg.norm(linear + jnp.cross(angular, hole_m[:, None]), axis=-1)

        def tools(q: Array, parts: RodParts) -> Array:
            """Return the places (2, 3) of gripper and payload, in SoRoMoX's axes."""
            end = robot.forward_kinematics(q, self._end_m[-1])
            return end[:3, 3] + parts.tool_offset_m[:, None] * end[:3, 0]

        def elastic(q: Array, pressure_kpa: Array, parts: RodParts) -> Array:
            """Return the energy [J] of backbone and fibres."""
            fibres = fibre_energy(stretch(q), pressure_kpa, parts).sum() / per_section
            return 0.5 * q @ robot.stiffness_matrix() @ q + fibres

        def energy(q: Array, pressure_kpa: Array, parts: RodParts) -> Array:
            """Return the energy [J] of the arm, weight included."""
            height_m = tools(q, parts) @ (_AXES.T @ parts.up)
            weight = robot.gravitational_energy(q) + GRAVITY_M_S2 * parts.tool_mass_kg @ height_m
            return elastic(q, pressure_kpa, parts) + weight

        # A linearly implicit Euler step; damping in proportion to the straight rod's stiffness
        gradient = jax.grad(energy)
        straight = jnp.zeros(robot.num_coordinates)
        no_kpa = jnp.zeros((n_sections, n_chambers))
        damping = CREEP_S * jnp.diag(jnp.diag(jax.hessian(elastic)(straight, no_kpa, parts)))

        def advance(q: Array, v: Array, pressure_kpa: Array, parts: RodParts, step_s: float) -> Any:
            """Return strains, rates, and the largest force before the step."""
            force, slope = (f(q, pressure_kpa, parts) for f in (gradient, jax.jacfwd(gradient)))
            inertia, bias, _ = robot.dynamics_terms(q, v)

            # Gripper and payload: inertia, and the force of their acceleration at constant rates
            def velocity(q: Array) -> Array:
                return jax.jvp(lambda q: tools(q, parts), (q,), (v,))[1]

            jacobian, kg = jax.jacfwd(tools)(q, parts), parts.tool_mass_kg  # (2, 3, n)
            acceleration = jax.jvp(velocity, (q,), (v,))[1]
            inertia += jnp.einsum("tki,tkj,t->ij", jacobian, jacobian, kg)
            bias += jnp.einsum("tki,tk,t->i", jacobian, acceleration, kg)
            matrix = inertia + step_s * damping + step_s**2 * slope
            pull = -force - bias - damping @ v - step_s * slope @ v
            v = v + jnp.linalg.solve(matrix, step_s * pull)
            return q + step_s * v, v, jnp.abs(force).max()

        self._advance, self._stretch = jax.jit(advance), jax.jit(stretch)
        self._q = self._v = np.zeros(robot.num_coordinates)

    def shape(self) -> Shape:
        """Return the rod's cross-sections."""
        frame = np.asarray(self._robot.forward_kinematics_abscissa_batched(self._q, self._end_m))
        roll = np.repeat(self._roll, self.per_section, axis=0)
        rotation = _AXES @ frame[:, :3, :3] @ _AXES.T @ np.concatenate([np.eye(3)[None], roll])
        return Shape(frame[:, :3, 3] @ _AXES.T, rotation)

    def chamber_lengths(self) -> np.ndarray:
        """Return the lengths (s c,) [m] of the chambers."""
        return self._lengths()[:, : self.parts.stiffness.shape[1]].ravel()

    def spring_lengths(self) -> np.ndarray:
        """Return the lengths (s k,) [m] of the springs."""
        return self._lengths()[:, self.parts.stiffness.shape[1] :].ravel()

    def _lengths(self) -> np.ndarray:
        """Return the lengths (s, c + k) [m] of chambers, then of springs."""
        return self.parts.section_length_m[:, None] * np.asarray(self._stretch(self._q)).mean(axis=1)

    def step(self, pressure_kpa: np.ndarray, duration_s: float) -> float:
        """Take a step at pressures (s c,) [kPa]; return the largest force before it."""
        pressures = pressure_kpa.reshape(self.parts.stiffness.shape)
        self._q, self._v, left = self._advance(self._q, self._v, pressures, self.parts, duration_s)
        return float(left)

    def settle(self, pressure_kpa: np.ndarray) -> None:
        """Move to rest at pressures (s c,) [kPa]; FloatingPointError if the rod does not come to rest."""
        left = np.inf
        for k in range(SETTLE_STEPS):
            self._v = np.zeros_like(self._v)
            left = self.step(pressure_kpa, min(0.1 * 2.0**k, LONGEST_S))
            if left < REST_TOLERANCE:
                self._v = np.zeros_like(self._v)
                return
        got = f"a force of {left:.2g} N m^2 or N m after {SETTLE_STEPS} steps"
        raise FloatingPointError(f"rod: got {got}, expected under {REST_TOLERANCE:g}")


def fibre_energy(stretch: Array, pressure_kpa: Array, parts: RodParts) -> Array:
    """Return the energy (s, per_section, c + k) [J] of fibres in segments, each as if it were a section.

    `stretch` has their lengths, divided by that of the segment; pressures are (s, c).
    """
    # Chambers, which harden, and the work of their pressures
    full_m, n_chambers = parts.section_length_m[:, None, None], parts.stiffness.shape[1]
    chamber_m, spring_m = jnp.split(full_m * stretch, [n_chambers], axis=-1)
    law = (parts.stiffness, parts.skew, parts.hardening, parts.rest_m, parts.area, parts.area_slope)
    stiffness, skew, hardening, rest_m, area, area_slope = (value[:, None] for value in law)
    off_m, longer_m = chamber_m - rest_m, chamber_m - full_m
    share = off_m / full_m
    chambers = stiffness * off_m**2 * (0.5 + skew * share / 3.0 + hardening * share**2 / 4.0)
    kpa = (pressure_kpa * (1.0 + parts.area_growth * pressure_kpa))[:, None]
    work = kpa * longer_m * (area + 0.5 * area_slope * longer_m)

    # Springs
    off_m = spring_m - parts.spring_rest_m[:, None, None]
    springs = 0.5 * parts.spring_stiffness[:, None, None] * off_m**2
    return jnp.concatenate([chambers - work, springs], axis=-1)


def robot_of(parts: RodParts, per_section: int) -> Any:
    """Return the backbone, with the mass of the sections, as a robot of SoRoMoX."""
    from soromox.systems import PCS, PCSStructure  # pyright: ignore[reportMissingImports]
    from soromox.systems.components import LinkSpec  # pyright: ignore[reportMissingImports]

    segment_m = parts.section_length_m / per_section
    stiffness = (parts.torsion, parts.bending, parts.bending, parts.extension, parts.shear, parts.shear)
    links = [
        LinkSpec.circular(
            length=float(length_m),
            density=float(mass_kg / (per_section * math.pi * RADIUS_M**2 * length_m)),
            radius=RADIUS_M,
            reference_strain=[0.0, 0.0, 0.0, 1.0, 0.0, 0.0],
            stiffness=np.diag(length_m * np.array(moduli)),
            damping=np.zeros((6, 6)),
        )
        for length_m, mass_kg, *moduli in zip(segment_m, parts.section_mass_kg, *stiffness, strict=True)
        for _ in range(per_section)
    ]
    gravity = -GRAVITY_M_S2 * _AXES.T @ parts.up
    base_pose = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])  # no turn (x, y, z, w); the default stands up
    return PCS.from_links(links, structure=PCSStructure(N_GAUSS_POINTS), gravity=gravity, base_pose=base_pose)


class SoromoxTwin(RodTwin):
    """A rod twin whose rod is SoRoMoX's."""

    rod_kind = SoromoxRod


class Arm(SoromoxTwin):
    """The paper's arm, a driver for `--arm`."""

    def __init__(self) -> None:
        super().__init__(0, build=AS_BUILT._replace(per_section=PER_SECTION))


def beside_rod(seed: int, n: int) -> dict[str, list[float]]:
    """Return the distances of the tips from those of `twin:rod:SEED` at n random pressures.

    Both have six pieces a section and no noise.
    """
    arms = [kind(seed, build=AS_BUILT._replace(noise=0.0)) for kind in (SoromoxTwin, RodTwin)]
    apart_mm = []
    for pressure_kpa in random_pressures(ArmSpec.default(), n, seed):
        for arm in arms:
            arm.settle(pressure_kpa)
        one, other = (arm.motion_capture().tip_m for arm in arms)
        apart_mm.append(1e3 * float(np.linalg.norm(one - other)))
    return {"apart_mm": apart_mm}


if __name__ == "__main__":
    print(json.dumps(beside_rod(*map(int, sys.argv[1:]))))
