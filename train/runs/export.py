"""A run's newest policy as the one file that the deployed arm loads."""

from __future__ import annotations

import datetime
from pathlib import Path

from mjx_softarm.mdp.actions import N_ACTIONS
from mjx_softarm.policy.file import check_actor, policy_from_actor, save_policy
from train.runs.arm_model import DistilledArm
from train.runs.checkpoint import RunError
from train.runs.folder import Run


def check_policy(run: Run) -> None:
    """Check that a run has a policy that can be exported.

    Raises:
        RunError: it has no checkpoint, or its policy is not a network that the file can hold.
    """
    try:
        check_actor(run.policy(), run.spec)
    except (ValueError, AttributeError) as error:
        raise RunError(f"{run.path}: {error}") from error


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
