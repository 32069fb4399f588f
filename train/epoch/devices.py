"""Training on several devices: arms, replay and batches are spread over them, networks are on all of them.

The devices form one axis. Arrays with a row for each arm, the replay's slots and each batch are split along
it. A device computes the gradients of its share of a batch, and XLA adds them up. The results are those of
one device but for the order of sums.

Several processes, on one host or on many, form one such axis, too, once they have met. All of them write
checkpoints to one folder; the first process alone writes all else.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from mjx_softarm._support.errors import InputError

AXIS = "devices"
CLUSTER = "cluster"
_MEETING = re.compile(r"([^/]+:\d+)/(\d+)/(\d+)")
HELP = (
    f"number of devices; default: 1. Or the devices of several processes: {CLUSTER}, where SLURM, Open MPI, "
    "Kubernetes or Cloud TPU started them, else HOST:PORT/K/N for the K-th of N, from 0, that meet there"
)


def mesh_of(devices: str | None) -> Mesh | None:
    """Return the devices to train on; call it before anything is computed.

    Args:
        devices: as `HELP` has it.

    Returns:
        Mesh with one axis of devices; None is one device.

    Raises:
        InputError: there are fewer devices, or the processes do not meet.
    """
    if devices is None or devices == "1":
        return None
    # Devices of this process.
    if devices.isdecimal() and int(devices):
        n = int(devices)
        local = jax.local_devices()
        if len(local) < n:
            on_cpu = jax.default_backend() == "cpu"
            hint = "; the environment variable JAX_NUM_CPU_DEVICES makes more of a CPU" * on_cpu
            raise InputError(f"--devices: got {n}, expected at most {len(local)}, which there are{hint}")
        return Mesh(np.array(local[:n]), (AXIS,))
    # Devices of several processes, which meet at an address or by the cluster's own means.
    meeting = _MEETING.fullmatch(devices)
    if not meeting and devices != CLUSTER:
        raise InputError(f"--devices: got {devices!r}, expected a number, {CLUSTER} or HOST:PORT/K/N")
    try:
        if meeting:
            address, process, n_processes = meeting.groups()
            jax.distributed.initialize(address, int(n_processes), int(process))
        else:
            jax.distributed.initialize()
    except (ValueError, RuntimeError) as error:
        raise InputError(f"--devices: got {devices} ({error}), expected processes that meet") from error
    return Mesh(np.array(jax.devices()), (AXIS,))


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


def is_first_process() -> bool:
    """Return whether this process is the one that writes."""
    return jax.process_index() == 0


def any_process(value: bool) -> bool:
    """Return whether a value is true in any process."""
    return bool(np.any(multihost_utils.process_allgather(np.array(value))))
