"""The arm at rest as a function of its numbers: what a fit of them needs."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from mjx_softarm.mechanics.kinematics import chain_frames
from mjx_softarm.mechanics.rest import rest, statics_at
from mjx_softarm.mechanics.statics import ArmParams


class Measured(NamedTuple):
    """What was measured of an arm at rest; rows of it are poses."""

    pressure_kpa: Any  # (n_chambers,)
    payload_kg: Any  # ()
    tip_m: Any  # (3,)
    tip_rotation: Any  # (3, 3)
    spring_m: Any  # (n_chambers,)


def with_numbers(x: Array, params: ArmParams) -> ArmParams:
    """An arm whose chambers and backbone differ from those of `params`.

    Args:
        x (4 * n_chambers + 1,): per chamber the logarithm of the stiffness's ratio; the logarithm of the
            area's; the change of the area's slope, in areas per section length; the change of the rest
            length, in section lengths. Last, the logarithm of the ratio of the backbone's bending stiffness.
        params: the arm at x = 0.
    """
    stiffness, area, slope, offset = x[:-1].reshape(4, -1)
    bend = jnp.exp(x[-1])
    joints = params.joint_stiffness.reshape(-1, 3) * jnp.stack([jnp.ones_like(bend), bend, bend])
    return params._replace(
        joint_stiffness=joints.reshape(-1),
        chamber_stiffness=params.chamber_stiffness * jnp.exp(stiffness),
        area=params.area * jnp.exp(area),
        area_slope=params.area_slope + slope * params.area / params.section_length_m,
        chamber_rest_m=params.chamber_rest_m + offset * params.section_length_m,
    )


def residuals(x: Array, params: ArmParams, measured: Measured) -> tuple[Array, Array, Array]:
    """Simulated less measured pose of one arm at rest.

    Args:
        x (4 * n_chambers + 1,): its numbers, see `with_numbers`.
        params: the arm at x = 0; its payload is taken from `measured`.
        measured: one pose.

    Returns:
        (6 + n_chambers,): tip [m]; rotation [rad], the axis times the sine of the angle; springs [m].
        (): largest force [N, N m] that is left on the arm.
        (n_chambers,) [m]: chamber lengths.
    """
    masses = jnp.stack([params.tool_mass_kg[0], measured.payload_kg])
    arm = with_numbers(x, params._replace(tool_mass_kg=masses))
    with jax.default_matmul_precision("highest"):  # a GPU would round products to 10 bits
        q = rest(arm, measured.pressure_kpa)
        frames = chain_frames(q, arm.link_length_m)
        now = statics_at(q, arm, measured.pressure_kpa)
        turn = measured.tip_rotation.T @ frames.plate_rotation[-1]
    angle = 0.5 * jnp.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    error = [frames.plate_position[-1] - measured.tip_m, angle, now.springs.length - measured.spring_m]
    left = jnp.max(jnp.abs(jax.lax.stop_gradient(now.gradient)))
    return jnp.concatenate(error), left, jax.lax.stop_gradient(now.chambers.length)
