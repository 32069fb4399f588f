"""A run's newest policy: the one file that the deployed arm loads, or the actor's weights alone."""

from __future__ import annotations

import datetime
import json
from pathlib import Path
from typing import Any

import numpy as np

from mjx_softarm._support.files import replacing
from mjx_softarm.mdp.actions import N_ACTIONS, ActionMap
from mjx_softarm.mdp.observation import ObsScale, layouts
from mjx_softarm.policy.actor import actor_layers, policy_from_actor
from mjx_softarm.policy.file import action_layout, save_policy
from train.runs.arm_model import DistilledArm
from train.runs.checkpoint import RunError
from train.runs.folder import Run


def check_policy(run: Run) -> None:
    """Check that a run has a policy that can be exported.

    Raises:
        RunError: it has no checkpoint, or its policy is not a network that the file can hold.
    """
    try:
        actor_layers(run.policy(), run.spec)
    except (ValueError, AttributeError) as error:
        raise RunError(f"{run.path}: {error}") from error


def export_weights(run: Run, path: Path) -> None:
    """Write the actor of a run's newest checkpoint as a plain npz file, and nothing else.

    `docs/export.md` runs such a file in twelve lines of NumPy. For k = 0, 1, ...:

        w<k> (in, out), b<k> (out,)      layers, with `activation` after each but the last, then tanh
        obs_layout (O,), action_layout (n,)   names of the entries
        centre, scale (6,) [mm, deg]     of poses and goals
        weight (6,) [1/mm, 1/deg]        of the error, pose less goal; 0 for an axis that no goal asks for
        low, high (n,)                   readings of the sensors that the actions -1 and 1 ask for
        provenance                       how the policy came about, as JSON

    Raises:
        RunError: the run has no checkpoint, or its policy is not a network that the file can hold.
        OSError: the file cannot be written.
    """
    env, spec = run.config.env, run.spec
    try:
        layers = actor_layers(run.policy(), spec)
    except (ValueError, AttributeError) as error:
        raise RunError(f"{run.path}: {error}") from error
    actions = ActionMap.from_spec(spec)
    arrays: dict[str, Any] = {}
    for k, (weight, bias) in enumerate(layers):
        arrays |= {f"w{k}": weight, f"b{k}": bias}
    arrays |= {
        "activation": run.config.learner.activation,
        "obs_layout": layouts(spec)[env.observation],
        "action_layout": action_layout(spec),
        **ObsScale.from_spec(spec)._asdict(),
        "weight": np.array(env.reward.weights),
        "low": actions.low,
        "high": actions.high,
        "provenance": json.dumps({**run.origin(), "epoch": run.checkpoints.latest}),
    }
    with replacing(path) as part, part.open("wb") as file:
        np.savez(file, **arrays)


def export_run(run: Run, arm: DistilledArm, path: Path | None = None) -> Path:
    """Write the policy of a run's newest checkpoint; return the file.

    Args:
        run: folder with config and checkpoint.
        arm: model of the run's arm, as `arm_model` makes it of `run.arm`.
        path: file to write; `policy.npz` in the run by default.

    Raises:
        RunError: the run has no checkpoint, or its learner's policy is not a network that the file can hold.
        SealedFileError: the file cannot be written.
    """
    # Say how the policy came about: the run's config with versions and commit, and the arm's networks.
    provenance = {
        **run.origin(),
        "epoch": run.checkpoints.latest,
        "estimator_errors": arm.errors,
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }
    # Put all together; this checks the shapes of the parameters.
    env, params = run.config.env, run.policy()
    try:
        policy = policy_from_actor(
            params,
            run.spec,
            env.reward,
            arm.model,
            provenance,
            activation=run.config.learner.activation,
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
