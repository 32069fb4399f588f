"""Training on several devices: arms, replay and batches are spread over them, networks are everywhere.

The devices form one axis. What has a row for each arm, and the slots of the replay, are split along it; a
batch is split once it is drawn, so each device computes the gradients of its share and XLA adds them up.
Arms settle on their device by themselves. The numbers are those of one device but for the order of sums.

Several processes, on one host or on many, form one such axis too, once they have met. All of them do the
same; the first alone writes, but for checkpoints, which all of them write to one folder.
"""

from __future__ import annotations

import re
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from train.config import ConfigError

AXIS = "devices"
CLUSTER = "cluster"
_MEETING = re.compile(r"([^/]+:\d+)/(\d+)/(\d+)")
HELP = (
    f"how many to train on; default: 1. Or those of several processes: {CLUSTER}, where SLURM, Open MPI, "
    "Kubernetes or Cloud TPU started them, else HOST:PORT/K/N for the K-th of N, from 0, that meet there"
)


def mesh_of(devices: str | None) -> Mesh | None:
    """The devices to train on; call it before anything is computed.

    Args:
        devices: what `HELP` says.

    Returns:
        The axis of devices; None is one device.

    Raises:
        ConfigError: there are fewer, or the processes do not meet.
    """
    if devices is None or devices == "1":
        return None
    if devices.isdecimal() and int(devices):
        return Mesh(np.array(_local(int(devices))), (AXIS,))
    meeting = _MEETING.fullmatch(devices)
    if not meeting and devices != CLUSTER:
        raise ConfigError(f"--devices: got {devices!r}, expected a number, {CLUSTER} or HOST:PORT/K/N")
    try:
        if meeting:
            address, process, n_processes = meeting.groups()
            jax.distributed.initialize(address, int(n_processes), int(process))
        else:
            jax.distributed.initialize()
    except (ValueError, RuntimeError) as error:
        raise ConfigError(f"--devices {devices}: {error}") from error
    return Mesh(np.array(jax.devices()), (AXIS,))


def _local(n: int) -> list[jax.Device]:  # pyright: ignore[reportInvalidTypeForm]
    found = jax.local_devices()
    if len(found) < n:
        hint = "; the environment variable JAX_NUM_CPU_DEVICES makes more of a CPU" * (
            jax.default_backend() == "cpu"
        )
        raise ConfigError(f"--devices: got {n}, expected at most {len(found)}, which there are{hint}")
    return found[:n]


def split(mesh: Mesh) -> NamedSharding:
    """Arrays whose first axis is spread over the devices."""
    return NamedSharding(mesh, PartitionSpec(AXIS))


def everywhere(mesh: Mesh) -> NamedSharding:
    """Arrays that each device has."""
    return NamedSharding(mesh, PartitionSpec())


def spread(mesh: Mesh | None, tree: Any) -> Any:
    """Within a traced function: arrays spread over the devices by their first axis."""
    return tree if mesh is None else jax.lax.with_sharding_constraint(tree, split(mesh))


def is_first_process() -> bool:
    """Whether this process is the one that writes."""
    return jax.process_index() == 0


def wait_for_all(what: str) -> None:
    """Wait until all processes are here."""
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices(what)


def any_process(value: bool) -> bool:
    """Whether it is true in any process."""
    if jax.process_count() == 1:
        return value
    return bool(np.any(multihost_utils.process_allgather(np.array(value))))
