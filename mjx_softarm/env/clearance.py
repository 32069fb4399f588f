"""Clearance of the arm's body to the pipe around it: at an instant, and along the path of an action."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from mjx_softarm._support.errors import InputError
from mjx_softarm.mechanics.kinematics import chain_kinematics
from mjx_softarm.mechanics.motion.state import Path
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.mechanics.pipe import CrossPipe, body_clearance
from mjx_softarm.posture import hangs
from mjx_softarm.sensing.s2r import S2R, carry_body
from mjx_softarm.spec import ArmSpec


class Walls:
    """Pipe around an arm. Without a pipe, distances are infinite."""

    def __init__(self, pipe: CrossPipe | None, spec: ArmSpec, params: ArmParams, s2r: S2R | None):
        if pipe is not None and not hangs(spec):
            raise InputError(
                f"pipe_diameter_mm: got {1e3 * pipe.diameter_m:g} for the arm {spec.name!r}, whose base is "
                f"turned by {spec.mounting.base_turn_deg} deg, expected an arm that hangs: pipes are entered "
                "from above"
            )
        self.pipe, self.spec, self.params, self.s2r = pipe, spec, params, s2r

    def clearance_mm(self, q: Array, pose: Array) -> Array:
        """Return the distance () of the body at joint coordinates (nv,), with its tip at a pose (6,)."""
        if self.pipe is None:
            return jnp.asarray(jnp.inf, q.dtype)
        frames = chain_kinematics(self.params)(q)
        return self._of_plates(self.pipe, frames.plate_position, frames.plate_rotation, pose)

    def least_mm(self, path: Path, pose: Array) -> Array:
        """Return the least distance () along a path whose tips have poses (t, 6), without its start."""
        if self.pipe is None or len(pose) == 1:  # nothing between start and end
            return jnp.asarray(jnp.inf, pose.dtype)
        plates = path.plate_position_m[1:], path.plate_rotation[1:]
        return jnp.min(self._of_plates(self.pipe, *plates, pose[1:]))

    def _of_plates(self, pipe: CrossPipe, position_m: Array, rotation: Array, pose: Array) -> Array:
        if self.s2r is not None:
            position_m, rotation = carry_body(position_m, rotation, pose)
        return 1e3 * body_clearance(pipe, position_m, rotation, self.spec)
