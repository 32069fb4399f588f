"""A run's newest policy as the one file that the deployed arm loads."""

from __future__ import annotations

import datetime
import json
from pathlib import Path

import jax

from mjx_softarm.export import policy_from_actor, save_policy
from train.checkpoint import Run
from train.run import restore_actor


def export_run(run: Run, path: Path | None = None) -> Path:
    """Write the policy of a run's newest checkpoint; returns the file, `policy.npz` in the run by default.

    Raises:
        RunError: the run has no checkpoint.
    """
    _, actor_params = restore_actor(run)
    provenance = {
        **json.loads((run.path / "config.json").read_text("utf-8")),
        "epoch": run.latest_epoch,
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }
    policy = policy_from_actor(jax.device_get(actor_params), run.spec, run.config.env.reward, provenance)
    path = path or run.path / "policy.npz"
    save_policy(path, policy)
    return path
