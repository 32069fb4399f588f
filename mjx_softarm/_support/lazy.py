"""Modules that are imported when they are first used: MuJoCo and MJX take more than a second."""

from __future__ import annotations

import contextlib
import copy
import functools
import importlib
import io
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax


class LazyModule:
    """Stand-in for a module: the first attribute that is asked for imports it."""

    def __init__(self, name: str):
        self._name = name

    def __getattr__(self, attribute: str) -> Any:
        return getattr(_import_quietly(self._name), attribute)


def _keep_bodies_apart() -> None:
    """Keep XLA from fusing MJX's computations of one body with those of the next.

    MJX writes a chain out body by body, and XLA's fusions repeat what bodies share: a plain `jax.jit` of the
    kinematics of a dozen links compiles for minutes on a CPU. A barrier after each body changes no number.
    With it MJX compiles in half of the time that the best options of `xla` take without it.
    """
    scan: Any = importlib.import_module("mujoco.mjx._src.scan")
    body_tree = scan.body_tree

    @functools.wraps(body_tree)
    def apart(m: Any, function: Callable, *rest: Any, **options: Any) -> Any:
        return body_tree(m, lambda *x: jax.lax.optimization_barrier(function(*x)), *rest, **options)

    scan.body_tree = apart


@functools.cache
def _import_quietly(name: str) -> Any:
    """Import a module; without warp, which nothing needs, `mujoco.mjx` would print two lines."""
    with contextlib.redirect_stdout(io.StringIO()) as said:
        module = importlib.import_module(name)
    for line in said.getvalue().splitlines():
        if not line.startswith(("Failed to import warp:", "Failed to import mujoco_warp:")):
            print(line)
    if name == "mujoco.mjx":
        _keep_bodies_apart()
    return module


if TYPE_CHECKING:
    import mujoco
    from brax import envs as brax_envs
    from mujoco import mjx
else:
    mujoco, mjx, brax_envs = map(LazyModule, ("mujoco", "mujoco.mjx", "brax.envs"))


def put(model: mujoco.MjModel) -> tuple[mjx.Model, mjx.Data]:
    """Return a compiled model and its data on the device.

    The actuators take any pressure: a closed chamber that is pressed together exceeds the limits of commands.
    """
    model = copy.copy(model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL
    return mjx.put_model(model), mjx.make_data(model)
