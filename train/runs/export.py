"""A run's newest policy as the one file that the deployed arm loads."""

from __future__ import annotations

import datetime
import functools
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np

from mjx_softarm.mdp.actions import N_ACTIONS
from mjx_softarm.mechanics.workspace import sample_evenly, sample_workspace
from mjx_softarm.policy.file import ArmModel, policy_from_actor, save_policy
from mjx_softarm.sensing.s2r import S2R, correct
from mjx_softarm.spec import ArmSpec
from train.runs.checkpoint import Run, RunError
from train.runs.estimator import Distilled, distil

N_WORKSPACE = 2048  # poses that stand for the workspace
SEED = 0  # seed of the networks and of the workspace
ERRORS = ("tip_mm", "turn_deg", "load_kg", "spring_mm")  # fields of `Distilled` that provenance keeps


def export_run(run: Run, path: Path | None = None) -> Path:
    """Write the policy of a run's newest checkpoint; return the file.

    Args:
        run: folder with config and checkpoint.
        path: file to write; `policy.npz` in the run by default.

    Raises:
        RunError: the run has no checkpoint, or its learner's policy is not a network that the file can hold.
        SealedFileError: the file cannot be written.
    """
    # Gather the networks and poses that the arm needs.
    model, distilled = arm_model(run.spec, run.s2r)
    # Put all together; this checks the shapes of the parameters.
    env = run.config.env
    try:
        policy = policy_from_actor(
            run.policy(),
            run.spec,
            env.reward,
            model,
            _provenance(run, distilled),
            observation=env.observation,
            tolerance_m=1e-3 * env.saturation_tolerance_mm,
            n_actions=N_ACTIONS,
            action_s=env.dynamic_step_s if env.moves else 0.0,
        )
    except (ValueError, AttributeError) as error:
        raise RunError(f"{run.path}: {error}") from error
    path = path or run.path / "policy.npz"
    save_policy(path, policy)
    return path


def arm_model(spec: ArmSpec, s2r: S2R | None) -> tuple[ArmModel, Distilled]:
    """Return an arm's networks and workspace, as the arm's computer needs them, and the networks' errors."""
    distilled = _distil(spec)
    networks = distilled.estimator, distilled.load_estimator, distilled.spring_model
    return ArmModel(_workspace(spec, s2r), *networks, s2r), distilled


def _workspace(spec: ArmSpec, s2r: S2R | None) -> np.ndarray:
    """Return poses (N_WORKSPACE, 6) of the real arm: half at random pressures, half uniform in volume."""
    halves = [sample(spec, N_WORKSPACE // 2, SEED) for sample in (sample_workspace, sample_evenly)]
    with jax.default_matmul_precision("highest"):  # a GPU would round products to 10 bits
        poses = [p.pose if s2r is None else correct(s2r, p.pose, p.spring_m) for p in halves]
    return np.concatenate(poses).astype(np.float32)


@functools.cache
def _distil(spec: ArmSpec) -> Distilled:
    """Return the arm's networks, distilled once for all policies that a process exports."""
    return distil(spec, SEED)


def _provenance(run: Run, distilled: Distilled) -> dict[str, Any]:
    """Return the run's config with versions and commit, its epoch, the networks' errors, and the date."""
    errors = {
        name: {f"{kg:g} kg": error._asdict() for kg, error in getattr(distilled, name).items()}
        for name in ERRORS
    }
    return {
        **json.loads((run.path / "config.json").read_text("utf-8")),
        "epoch": run.latest_epoch,
        "estimator_errors": errors,
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }
