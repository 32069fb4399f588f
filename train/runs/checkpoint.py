"""Checkpoints of a run: all that it needs to go on, and the parts of its learner that others take."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax

from mjx_softarm._support.errors import InputError
from mjx_softarm._support.lazy import LazyModule

if TYPE_CHECKING:
    import orbax.checkpoint as ocp
else:
    ocp = LazyModule("orbax.checkpoint")

N_KEPT = 2
# Codes that begin a message of TensorStore about files that are cut, changed or absent
_DAMAGE = ("DATA_LOSS", "OUT_OF_RANGE", "NOT_FOUND", "FAILED_PRECONDITION")


class Checkpoints:
    """The newest checkpoints of a run, in the subfolder `checkpoints` of its folder."""

    def __init__(self, run: Path):
        self.run, self.path = run, run / "checkpoints"

    @functools.cached_property
    def _manager(self) -> ocp.CheckpointManager:
        options = ocp.CheckpointManagerOptions(max_to_keep=N_KEPT, enable_async_checkpointing=False)
        return ocp.CheckpointManager(self.path.resolve(), options=options)

    @property
    def epochs(self) -> list[int]:
        """Numbers of epochs behind the complete checkpoints."""
        return sorted(self._manager.all_steps()) if self.path.exists() else []

    @property
    def latest(self) -> int | None:
        """Number of epochs behind the newest complete checkpoint, None if there is none."""
        return max(self.epochs, default=None)

    def rewind(self, epoch: int) -> None:
        """Delete the checkpoints that are later than an epoch."""
        for later in [saved for saved in self.epochs if saved > epoch]:
            self._manager.delete(later)

    def save(self, epoch: int, state: Any, parts: dict[str, Any]) -> None:
        """Write a checkpoint; an interrupted write leaves the one before it in force.

        Args:
            epoch: number of epochs done.
            state: all that the run needs to go on.
            parts: what export and other runs need of the learner; see `train.epoch.replay_epoch.Learner`.
        """
        both = {"state": state, "parts": jax.device_get(parts)}
        saved = {name: ocp.args.StandardSave(item) for name, item in both.items()}
        self._manager.save(epoch, args=ocp.args.Composite(**saved))
        self._manager.wait_until_finished()

    def restore(self, like: Any) -> tuple[int, Any]:
        """Return the newest checkpoint: epochs done, and state.

        Args:
            like: a state, or its shapes, structured as the run's.

        Raises:
            InputError: there is no checkpoint, or it has another structure.
        """
        shapes = ocp.args.StandardRestore(jax.tree.map(_shape_somewhere, like))
        return self._newest("state", shapes)

    def parts(self) -> dict[str, Any]:
        """Return the newest checkpoint's parts of the learner as NumPy arrays; see `Learner.parts`.

        Raises:
            InputError: there is no checkpoint, or it is another version's.
        """
        return self._newest("parts", ocp.args.StandardRestore())[1]

    def _newest(self, item: str, how: ocp.args.CheckpointArgs) -> tuple[int, Any]:
        """Return the number of epochs behind the newest checkpoint, and an item of it."""
        epoch = self.latest
        if epoch is None:
            raise InputError(f"{self.run}: got no checkpoint, expected one; start the run anew")
        try:
            return epoch, self._manager.restore(epoch, args=ocp.args.Composite(**{item: how}))[item]
        except Exception as error:
            folder = self.path / str(epoch)
            if _is_damage(folder / item, error):
                earlier = [saved for saved in self.epochs if saved < epoch]
                remedy = f"; without {folder} the run goes back to epoch {earlier[-1]}" if earlier else ""
                raise InputError(
                    f"{folder / item}: got a damaged checkpoint ({str(error).splitlines()[0][:200]}), "
                    f"expected it as it was written{remedy}"
                ) from error
            if not isinstance(error, (ValueError, KeyError)):
                raise
            raise InputError(
                f"{self.run}: got a checkpoint of other parts or sizes, expected this version's; "
                "continue it with the commit that its config.json names"
            ) from error


def _is_damage(folder: Path, error: Exception) -> bool:
    """Return whether the files of a checkpoint's item are damaged, rather than those of another version."""
    chain = (error, error.__cause__)  # the reading of an array fails in a thread
    unread = isinstance(error, (UnicodeDecodeError, json.JSONDecodeError, FileNotFoundError))
    return (
        unread
        or not (folder / "_METADATA").exists()
        or any(code in str(one) for one in chain if one is not None for code in _DAMAGE)
    )


def _shape_somewhere(x: Any) -> jax.ShapeDtypeStruct:
    """Return shape, type and device of an array; by default this process's first device.

    Otherwise orbax restores to the devices of the saved array, which may not exist here.
    """
    shape = ocp.utils.to_shape_dtype_struct(x)
    assert isinstance(shape, jax.ShapeDtypeStruct)  # a state has no plain numbers
    if shape.sharding is not None:
        return shape
    device = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
    return jax.ShapeDtypeStruct(shape.shape, shape.dtype, sharding=device)
