"""MJX and brax, imported in one place.

`mujoco.mjx` prints two lines at import if warp is not installed. Only the engine "warp" needs it, so these
lines are held back. Neither package has enough types to be checked, so type checkers see `Any`.
"""

from __future__ import annotations

import contextlib
import copy
import io
from typing import TYPE_CHECKING, Any

import jax
import mujoco

from mjx_softarm._support.errors import InputError

if TYPE_CHECKING:
    from mujoco import mjx

    class Env(Any): ...

    class State(Any): ...

else:
    with contextlib.redirect_stdout(io.StringIO()) as said:
        from brax.envs.base import Env, State
        from mujoco import mjx
    for line in said.getvalue().splitlines():
        if not line.startswith(("Failed to import warp:", "Failed to import mujoco_warp:")):
            print(line)

__all__ = ["Env", "State", "mjx", "put"]


def put(model: mujoco.MjModel, warp: bool = False) -> tuple[mjx.Model, mjx.Data]:
    """Return a compiled model and its data on the device, for MJX in JAX or for MJX-Warp.

    The actuators take any pressure: a closed chamber that is pressed together exceeds the limits of commands.

    Raises:
        InputError: MJX-Warp without a GPU or without warp-lang.
    """
    model = copy.copy(model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL
    if not warp:
        return mjx.put_model(model), mjx.make_data(model)
    if jax.default_backend() != "gpu":
        raise InputError(f"engine 'warp': got a {jax.default_backend()}, expected a GPU")
    try:
        return mjx.put_model(model, impl="warp"), mjx.make_data(model, impl="warp")
    except RuntimeError as error:
        raise InputError(f"engine 'warp': got {error!r}, expected `pip install warp-lang`") from error
