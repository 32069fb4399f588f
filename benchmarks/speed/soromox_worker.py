"""Worker: arms that SoRoMoX moves in time, compiled, on all cores.

    python -m benchmarks.speed.soromox_worker METHOD N_ARMS

The arm has one segment of constant strain for each section. It bends and stretches; without torsion and
shear, the stiffest motions, an explicit step may be three times as long. Each round holds random pressures,
as forces on the segments, and has neither a control law nor valves. METHOD is

    explicit    Euler's step on SoRoMoX's accelerations, the longest that is stable. Runge-Kutta methods allow
                1.0 to 1.8 times that, at two to six times the cost.
    implicit    the linearised midpoint rule of `mjx_softarm.mechanics.motion.midpoint` on SoRoMoX's inertia
                and forces, with a control period's step

Source: SoRoMoX, https://github.com/tud-phi/soromox.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.harness.rounds import Facts, n_cores, serve
from mjx_softarm.mechanics.body import chamber_directions, holes_m
from mjx_softarm.spec import ArmSpec

HELD_S = 0.5  # duration of a set of pressures, as of an environment step in motion
N_STEPS = {"explicit": 667, "implicit": 25}  # in it; with 625 explicit ones, one arm in 128 diverged
ROUND_S = 1.0  # least time of a round
CHECKED_S = 2.0  # of random motion before the first round; every arm must stay finite
N_GAUSS_POINTS = 2  # for speed; the default is five
BENDS_AND_STRETCHES = (False, True, True, True, False, False)  # torsion, bending, stretch, shear


def section_matrices(spec: ArmSpec, kind: str) -> np.ndarray:
    """Return each section's "stiffness" or "damping" (n_sections, 6, 6): torsion, bending, stretch, shear.

    Torsion and shear, which the arm does not do, get the values of bending and stretch.
    """
    # Chambers and springs of a section together, each row of (2, n_sections)
    n, geometry = spec.structure.n_sections, spec.geometry
    per_m, per_rad = ("n_per_m", "nm_per_rad") if kind == "stiffness" else ("ns_per_m", "nms_per_rad")
    chambers = np.reshape(spec.per_chamber(getattr(spec.chambers, f"{kind}_{per_m}")), (n, -1)).sum(axis=1)
    springs = spec.at_springs(getattr(spec.springs, f"{kind}_{per_m}")).reshape(n, -1).sum(axis=1)
    radii = [spec.per_section(radius) for radius in (geometry.chamber_radius_m, geometry.spring_radius_m)]
    rods = np.stack([chambers, springs])

    # A rod at angle a bends by its stiffness times (r cos a)^2, half of r^2 on average
    axial = rods.sum(axis=0) + spec.per_section(getattr(spec.backbone, f"axial_{kind}_{per_m}"))
    bending = 0.5 * np.sum(rods * np.square(radii), axis=0)
    bending = bending + spec.per_section(getattr(spec.backbone, f"bending_{kind}_{per_rad}"))
    diagonal = np.stack([bending] * 3 + [axial] * 3, axis=-1)
    per_strain = np.square(spec.per_section(geometry.section_length_m))[:, None] * diagonal
    return per_strain[:, :, None] * np.eye(6)


def random_forces(spec: ArmSpec, n: int, rng: np.random.Generator) -> np.ndarray:
    """Return the generalised forces (n, 3 * n_sections) of random pressures in the arm's range."""
    low, high = spec.chambers.pressure_min_kpa, spec.chambers.pressure_max_kpa
    directions = chamber_directions(spec)  # (n_sections, c, 2)
    pressure = rng.uniform(low, high, (n, *directions.shape[:2]))
    force_n = 1e3 * np.reshape(spec.per_chamber(spec.chambers.area_m2), directions.shape[:2]) * pressure
    x, y = np.moveaxis(holes_m(directions, spec.per_section(spec.geometry.chamber_radius_m)), -1, 0)
    arms = np.stack([y, -x, np.ones_like(x)], axis=-1)  # (n_sections, c, 3)
    length_m = np.array(spec.per_section(spec.geometry.section_length_m))[:, None]
    return (length_m * np.einsum("nsc,sck->nsk", force_n, arms)).reshape(n, -1)


def build_robot(spec: ArmSpec) -> Any:
    """Return the arm as a hanging robot of SoRoMoX; the gripper's mass is spread over the last section."""
    from soromox.systems import PCS, PCSStructure  # pyright: ignore[reportMissingImports]
    from soromox.systems.components import LinkSpec  # pyright: ignore[reportMissingImports]

    geometry, n = spec.geometry, spec.structure.n_sections
    radius_m = np.add(
        spec.per_section(geometry.chamber_radius_m),
        0.5 * np.array(spec.per_section(geometry.chamber_diameter_m)),
    )
    mass_kg = np.array(spec.section_mass_kg)
    mass_kg[-1] += spec.mass.gripper_kg + spec.mass.payload_kg

    stiffness, damping = (section_matrices(spec, kind) for kind in ("stiffness", "damping"))
    links = [
        LinkSpec.circular(
            length=length_m,
            density=float(mass_kg[k]) / (math.pi * float(radius_m[k]) ** 2 * length_m),
            radius=float(radius_m[k]),
            reference_strain=[0.0, 0.0, 0.0, 1.0, 0.0, 0.0],
            stiffness=stiffness[k],
            damping=damping[k],
        )
        for k, length_m in enumerate(spec.per_section(geometry.section_length_m))
    ]
    structure = PCSStructure(N_GAUSS_POINTS, list(BENDS_AND_STRETCHES) * n)
    gravity = np.array([0.0, 0.0, 9.81])  # the straight arm extends along z
    return PCS.from_links(links, structure=structure, gravity=gravity)


def stepper(robot: Any, method: str, step_s: float) -> Callable[[Any, Any], Any]:
    """Return a function (state, forces) -> next state, of strains and rates (2 n,) and forces (n,)."""
    import jax.numpy as jnp
    from jax.scipy.linalg import solve

    def explicit(state, force):
        return state + step_s * robot.forward_dynamics(0.0, state, (force,))

    def implicit(state, force):
        q, v = jnp.split(state, 2)
        middle = q + 0.5 * step_s * v
        inertia, bias, weight = robot.dynamics_terms(middle, v)
        stiffness, damping = robot.stiffness_matrix(), robot.damping_matrix(middle)
        force = force - bias - weight - stiffness @ middle - damping @ v
        matrix = inertia + 0.5 * step_s * damping + 0.25 * step_s**2 * stiffness
        dv = solve(matrix, step_s * force, assume_a="pos")
        return jnp.concatenate([q + step_s * (v + 0.5 * dv), v + dv])

    return {"explicit": explicit, "implicit": implicit}[method]


def move(method: str, n_arms: str) -> tuple[Facts, Callable[[], Facts]]:
    """Prepare n arms, and check that they stay finite for `CHECKED_S`."""
    import jax
    from jax.sharding import Mesh, PartitionSpec

    jax.config.update("jax_num_cpu_devices", n_cores())  # XLA runs most of this on one core of a device
    spec, n, rng = ArmSpec.default(), int(n_arms), np.random.default_rng(0)
    step_s = HELD_S / N_STEPS[method]
    step = stepper(build_robot(spec), method, step_s)

    def held(state, force):
        return jax.lax.fori_loop(0, N_STEPS[method], lambda _, state: step(state, force), state)

    mesh = Mesh(np.array(jax.devices()[: math.gcd(n, len(jax.devices()))]), ("arms",))
    split, many = PartitionSpec("arms"), jax.vmap(held)
    run = jax.jit(jax.shard_map(many, mesh=mesh, in_specs=split, out_specs=split, check_vma=False))
    state = np.zeros((n, 6 * spec.structure.n_sections), np.float32)  # at rest: strains and their rates
    calls = 1

    def work() -> Facts:
        nonlocal state
        forces = [random_forces(spec, n, rng).astype(np.float32) for _ in range(calls)]
        start = time.perf_counter()
        for force in forces:
            state = run(state, force)
        state = jax.block_until_ready(state)
        rate = calls * n * HELD_S / (time.perf_counter() - start)
        if not np.isfinite(state).all():
            raise FloatingPointError(f"step: got {step_s:.2g} s, which diverges, expected a stable one")
        return {"simulated_s_per_s": rate}

    # Move for a while, and choose how many sets of pressures make a round; the first call compiles.
    for _ in range(round(CHECKED_S / HELD_S)):
        rate = work()["simulated_s_per_s"]
    calls = max(1, round(ROUND_S * rate / (n * HELD_S)))
    return {"arms": n, "step_ms": round(1e3 * step_s, 2)}, work


if __name__ == "__main__":
    serve(lambda: move(*sys.argv[1:]))
