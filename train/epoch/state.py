"""State of a run: all that it consists of, and how its parts are spread over devices."""

from __future__ import annotations

from typing import Any, NamedTuple, cast

from jax import Array
from jax.sharding import Mesh

from train.config import ConfigError
from train.epoch import replay
from train.epoch.devices import everywhere, split


class TrainState(NamedTuple):
    """All that a run consists of; with it, a run continues bit for bit."""

    arms: Any  # State of n_arms, None where the learner has its own
    learner: Any  # state of the learner
    memory: Any  # Ring of Experience, None where the learner has its own arms
    goals: Any  # state of the goals' distribution
    key: Array
    n_epochs: Array  # () int32 epochs done; counts of env steps would overflow within hours


def sharding_of(config: Any, mesh: Mesh, own_arms: bool) -> TrainState:
    """Return where the parts of a state are, as a prefix of its tree.

    Raises:
        ConfigError: arms, replay or batches cannot be split evenly.
    """
    for name in ("n_arms", *(() if own_arms else ("replay_capacity", "batch_size"))):
        if getattr(config, name) % mesh.size:
            raise ConfigError(
                f"learner.{name}: got {getattr(config, name)}, expected a multiple of the {mesh.size} devices"
            )
    on_all, rows = cast(Any, everywhere(mesh)), split(mesh)  # in the places of arrays
    everything: dict[str, Any] = dict.fromkeys(TrainState._fields, on_all)
    everything["arms"] = None if own_arms else rows
    everything["memory"] = None if own_arms else replay.Ring(data=rows, position=on_all, size=on_all)
    return TrainState(**everything)
