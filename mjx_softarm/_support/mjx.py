"""MJX and brax, imported in one place.

`mujoco.mjx` prints two lines at import if warp is not installed. Nothing here uses warp, so these lines are
held back. Neither package has enough types to be checked, so type checkers see `Any`.
"""

from __future__ import annotations

import contextlib
import io
from typing import TYPE_CHECKING, Any

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

__all__ = ["Env", "State", "mjx"]
