"""MJX's own forces on an arm at rest: the engine "mjx" without motion.

The closed form of `mjx_softarm.mechanics.settle` proposes an equilibrium, joint coordinates and pressures.
One pass of MJX through the compiled model then measures it: its kinematics give the tip, its tendons the
springs, and its forces the verdict. At rest nothing moves, so they balance where

    qfrc_passive + qfrc_actuator - qfrc_bias = 0,

stiffness of joints and tendons, pressures through the actuators, and gravity. So the model is MJX's, and the
closed form only its solver. Where the largest entry exceeds `settle`'s tolerance, the arm is `UNBALANCED`.

Source: MuJoCo's documentation, "Computation", equation of motion at zero velocity and acceleration.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from mjx_softarm._support.lazy import mjx
from mjx_softarm.mechanics.kinematics import tip_of
from mjx_softarm.mechanics.mjcf import episode_model, spring_lengths
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.mechanics.settle import RESIDUAL_TOLERANCE, Settled, SettleResult


def measured(model: mjx.Model, data: mjx.Data, params: ArmParams, proposed: Settled) -> Settled:
    """Return an equilibrium as MJX measures it: tip, spring lengths, residual and result.

    An arm that did not settle keeps its result. The model's actuators take any pressure. Masses and
    stiffnesses of `params` take the place of the model's; `data` are those of the model at rest.
    """
    model = episode_model(model, params)
    data = data.replace(qpos=proposed.q, ctrl=proposed.pressure_kpa)
    # Velocities are zero: so are MJX's velocities of bodies and tendons in fresh data
    positions = mjx.kinematics, mjx.com_pos, mjx.tendon, mjx.transmission
    forces = mjx.passive, mjx.rne, mjx.fwd_actuation
    with jax.default_matmul_precision("highest"):  # a GPU would round products to 10 bits
        for stage in (*positions, *forces):
            data = stage(model, data)
    residual = jnp.max(jnp.abs(data.qfrc_passive + data.qfrc_actuator - data.qfrc_bias))
    tip_position_m, tip_rotation = tip_of(data)

    # A residual that is NaN is no balance
    unbalanced = proposed.settled & ~(residual < RESIDUAL_TOLERANCE)
    return proposed._replace(
        spring_m=spring_lengths(data, len(params.area), len(params.spring_rest_m)),
        tip_position_m=tip_position_m,
        tip_rotation=tip_rotation,
        residual=residual,
        result=jnp.where(unbalanced, SettleResult.UNBALANCED.value, proposed.result),
    )
