"""Networks and workspace of an arm for its computer; the same for every policy that drives the arm."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import numpy as np

from mjx_softarm.mechanics.workspace import sample_evenly, sample_workspace
from mjx_softarm.policy.file import ArmModel
from mjx_softarm.sensing.s2r import S2R, correct
from mjx_softarm.spec import ArmSpec
from train.runs.estimator import Distilled, distil

N_WORKSPACE = 2048  # poses that stand for the workspace
SEED = 0  # seed of the networks and of the workspace


class DistilledArm(NamedTuple):
    """A model of an arm, with the errors of its networks."""

    model: ArmModel
    errors: dict[str, Any]  # by name and payload, in types that JSON has


def arm_model(spec: ArmSpec, s2r: S2R | None) -> DistilledArm:
    """Return the model of an arm, which is distilled once in a process.

    Args:
        spec: the arm, calibrated or not.
        s2r: sim-to-real network of its calibration, if there is one.

    Raises:
        SpecError: the arm settles at too few pressures.
    """
    distilled = _distil(spec)
    networks = distilled.estimator, distilled.load_estimator, distilled.spring_model
    errors = {
        name: {f"{kg:g} kg": error._asdict() for kg, error in by_payload.items()}
        for name, by_payload in distilled.errors.items()
    }
    return DistilledArm(ArmModel(_workspace(spec, s2r), *networks, s2r), errors)


def _workspace(spec: ArmSpec, s2r: S2R | None) -> np.ndarray:
    """Return poses (N_WORKSPACE, 6) of the real arm: half at random pressures, half uniform in volume."""
    halves = [sample(spec, N_WORKSPACE // 2, SEED) for sample in (sample_workspace, sample_evenly)]
    with jax.default_matmul_precision("highest"):  # a GPU would round products to 10 bits
        poses = [p.pose if s2r is None else correct(s2r, p.pose, p.spring_m) for p in halves]
    return np.concatenate(poses).astype(np.float32)


@functools.cache
def _distil(spec: ArmSpec) -> Distilled:
    return distil(spec, SEED)
