"""A run's newest policy as the one file that the deployed arm loads."""

from __future__ import annotations

import datetime
import functools
import json
from pathlib import Path

import jax
import numpy as np

from mjx_softarm.env import ReachEnv
from mjx_softarm.mdp.actions import N_ACTIONS
from mjx_softarm.policy.file import ArmModel, policy_from_actor, save_policy
from mjx_softarm.spec import ArmSpec
from train.runs.checkpoint import Run, RunError
from train.runs.estimator import Distilled, distil
from train.runs.run import restore_policy
from train.runs.task import Task

N_WORKSPACE = 2048  # poses that stand for the workspace
SEED = 0  # seed of the estimator


def export_run(run: Run, path: Path | None = None, task: Task | None = None) -> Path:
    """Write the policy of a run's newest checkpoint; return the file.

    Args:
        run: folder with config and checkpoint.
        path: file to write; `policy.npz` in the run by default.
        task: task of the run, where its learner is not the one that its config names.

    Raises:
        RunError: the run has no checkpoint, or its learner's policy is not a network that the file can hold.
        SealedFileError: the file cannot be written.
    """
    task, params = restore_policy(run, task)
    model, distilled = arm_model(task.job.env)
    errors = {name: getattr(distilled, name) for name in ("tip_mm", "turn_deg", "load_kg", "spring_mm")}
    provenance = {
        **json.loads((run.path / "config.json").read_text("utf-8")),
        "epoch": run.latest_epoch,
        "estimator_errors": {
            name: {f"{payload_kg:g} kg": error._asdict() for payload_kg, error in by_payload.items()}
            for name, by_payload in errors.items()
        },
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }
    try:
        policy = policy_from_actor(
            jax.device_get(params),
            run.spec,
            run.config.env.reward,
            model,
            provenance,
            tolerance_m=1e-3 * run.config.env.saturation_tolerance_mm,
            n_actions=N_ACTIONS,
            action_s=run.config.env.dynamic_step_s if run.config.env.moves else 0.0,
        )
    except (ValueError, AttributeError) as error:
        raise RunError(f"{run.path}: {error}") from error
    path = path or run.path / "policy.npz"
    save_policy(path, policy)
    return path


def arm_model(env: ReachEnv) -> tuple[ArmModel, Distilled]:
    """Return the deployed arm's model of an environment's arm, and its errors."""
    distilled = _distil(env.spec)
    halves = [env.sample_pool(N_WORKSPACE // 2, SEED, evenly).pose for evenly in (False, True)]
    workspace = np.concatenate(halves).astype(np.float32)
    networks = distilled.estimator, distilled.load_estimator, distilled.spring_model
    return ArmModel(workspace, *networks, env.s2r), distilled


@functools.cache
def _distil(spec: ArmSpec) -> Distilled:
    """Return the arm's networks, distilled once for all policies that a process exports."""
    return distil(spec, SEED)
