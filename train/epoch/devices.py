"""Training on several devices: arms, replay and batches are spread over them, networks are on all of them.

The devices form one axis. Arrays with a row for each arm, the replay's slots and each batch are split along
it. A device computes the gradients of its share of a batch, and XLA adds them up. The results are those of
one device but for the order of sums.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from mjx_softarm._support.errors import InputError

AXIS = "devices"


def mesh_of(n: int) -> Mesh | None:
    """Return n devices to train on, a mesh with one axis; None is one device.

    Raises:
        InputError: there are fewer devices.
    """
    if n == 1:
        return None
    known = jax.devices()
    if not 1 <= n <= len(known):
        on_cpu = jax.default_backend() == "cpu"
        hint = "; the environment variable JAX_NUM_CPU_DEVICES makes more of a CPU" * on_cpu
        raise InputError(f"--devices: got {n}, expected 1 to {len(known)}, which there are{hint}")
    return Mesh(np.array(known[:n]), (AXIS,))


def check_split(config: Any, names: Sequence[str], mesh: Mesh) -> None:
    """Raise InputError where one of some numbers of a learner cannot be split evenly over the devices."""
    for name in names:
        if getattr(config, name) % mesh.size:
            raise InputError(
                f"learner.{name}: got {getattr(config, name)}, expected a multiple of the {mesh.size} devices"
            )


def split(mesh: Mesh) -> NamedSharding:
    """Return the sharding of arrays whose first axis is spread over the devices."""
    return NamedSharding(mesh, PartitionSpec(AXIS))


def everywhere(mesh: Mesh) -> NamedSharding:
    """Return the sharding of arrays that each device has whole."""
    return NamedSharding(mesh, PartitionSpec())


def spread(mesh: Mesh | None, tree: Any) -> Any:
    """Spread arrays over the devices by their first axis, within a traced function."""
    return tree if mesh is None else jax.lax.with_sharding_constraint(tree, split(mesh))
