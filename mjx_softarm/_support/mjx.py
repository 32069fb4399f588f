"""MJX and brax, imported in one place.

`mujoco.mjx` prints two lines at import if warp is not installed. Only the engine "warp" needs it, so these
lines are held back. Neither package has enough types to be checked, so type checkers see `Any`.
"""

from __future__ import annotations

import contextlib
import io
from typing import TYPE_CHECKING, Any

import jax
import mujoco

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

    Raises:
        RuntimeError: MJX-Warp without a GPU or without warp-lang.
    """
    if warp and jax.default_backend() != "gpu":
        raise RuntimeError(f"engine 'warp': got a {jax.default_backend()}, expected a GPU")
    impl = "warp" if warp else "jax"
    try:
        return mjx.put_model(model, impl=impl), mjx.make_data(model, impl=impl)
    except RuntimeError as error:
        raise RuntimeError(f"engine {impl!r}: got {error!r}, expected `pip install warp-lang`") from error
