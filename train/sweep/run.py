"""Host side of a sweep: its folder, and the loop that trains all members at once.

Each member has the folder of an ordinary run, and every command on a run works on a member. After a killed
process the members may have checkpoints of different epochs; they continue from the newest common one.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from mjx_softarm._support.provenance import provenance, write_json
from mjx_softarm.env import EnvConfig, ReachEnv
from mjx_softarm.sensing.s2r import S2R
from mjx_softarm.spec import ArmSpec
from train.config import TrainConfig
from train.epoch.job import TrainState
from train.runs.checkpoint import Run, RunError
from train.runs.run import (
    Interrupted,
    asked_to_stop,
    evaluation,
    finish,
    open_board,
    record,
    shown_progress,
    timed_epoch,
)
from train.runs.task import Task, task_of
from train.sweep.job import SweepJob, with_env_config

SWEEP_FILE = "sweep.json"


@dataclass(frozen=True)
class Sweep:
    """The folder of a sweep: `sweep.json`, its members' folders and, at the end, table and plot."""

    path: Path
    runs: tuple[Run, ...]
    varied: tuple[str, ...]  # settings in which the members differ, besides their seeds

    @property
    def epoch(self) -> int:
        """Newest epoch that all members have a checkpoint of; 0 without any."""
        return max(set.intersection(*(set(run.epochs) for run in self.runs)), default=0)


def create(
    path: Path,
    members: Mapping[str, TrainConfig],
    varied: Sequence[str],
    spec: ArmSpec,
    s2r: S2R | None = None,
) -> Sweep:
    """Start the folder of a sweep, whole or not at all.

    Args:
        path: folder to make.
        members: configs by the names of their folders.
        varied: settings in which the members differ, besides their seeds.
        spec: the arm.
        s2r: sim-to-real network of the arm's calibration, if there is one.

    Raises:
        RunError: there is such a folder already, or it cannot be made.
    """
    # Make the members' folders beside the final one, and rename the whole at the end.
    if path.exists():
        expected = f"a new folder; --resume {path} continues this one"
        raise RunError(f"--out: got {path}, which is there already, expected {expected}")
    part = path.with_name(path.name + ".part")
    shutil.rmtree(part, ignore_errors=True)  # left by a start that was interrupted
    for name, config in members.items():
        Run.create(part / name, config, spec, s2r)
    data = {"members": list(members), "varied": list(varied), "provenance": provenance("train")}
    try:
        write_json(part / SWEEP_FILE, data)
        part.replace(path)
    except OSError as error:
        raise RunError(f"{path}: got {error.strerror!r}, expected to write a new folder") from error
    return open_sweep(path)


def open_sweep(path: Path) -> Sweep:
    """Open an existing folder.

    Raises:
        RunError: there is no sweep in it, or it cannot be read.
    """
    file = path / SWEEP_FILE
    try:
        data = json.loads(file.read_text("utf-8"))
        members, varied = data["members"], tuple(data["varied"])
    except OSError as error:
        raise RunError(f"{file}: got {error.strerror!r}, expected the folder of a sweep") from error
    except (ValueError, KeyError, TypeError) as error:
        raise RunError(f"{file}: got {error!r}, expected the fields 'members' and 'varied'") from error
    return Sweep(path, tuple(Run.open(path / name) for name in members), varied)


def train(sweep: Sweep, console: Console) -> None:
    """Train all members to their end, from the newest checkpoints that they have in common.

    Raises:
        Interrupted: after Ctrl-C or a termination signal, once the states are saved.
    """
    # Prepare the job, and the state after the newest common epoch.
    console.print("drawing goals from the reachable workspace ...")
    run = sweep.runs[0]
    env = ReachEnv(run.spec, run.config.env, run.s2r)
    job = SweepJob([run.config for run in sweep.runs], sweep.varied, env)
    tasks, config, epoch = _tasks(sweep, env), run.config, sweep.epoch
    if epoch:
        console.print(f"continuing after epoch {epoch} of {config.learner.n_epochs}")
    states = _start(sweep, job, epoch)
    console.print("compiling (cached for the next start) ...")
    with (
        asked_to_stop() as asked,
        ExitStack() as stack,
        shown_progress(config, epoch, console) as show,
    ):
        boards = [stack.enter_context(open_board(run, epoch)) for run in sweep.runs]
        while epoch < config.learner.n_epochs:
            # Train an epoch; metrics without an axis of members are the same for all.
            states, metrics = timed_epoch(job, states, config.learner, epoch)
            rows = [
                {name: float(x[k] if np.ndim(x) else x) for name, x in metrics.items()} for k in range(job.n)
            ]
            epoch += 1
            stop, due = bool(asked), config.evaluates_after(epoch)
            # Evaluate, record and save each member as an ordinary run.
            for k, (run, board, row) in enumerate(zip(sweep.runs, boards, rows, strict=True)):
                member = job.member(states, k) if due or stop else None
                if member is not None and due:
                    row |= evaluation(run, tasks[run.config.env], job.learner.policy(member.learner))
                record(run, board, epoch, row)
                if member is not None:
                    run.save(epoch, member, job.learner.parts(member.learner))
            show(epoch, _line(rows), due)
            if stop and epoch < config.learner.n_epochs:
                raise Interrupted(f"stopped after epoch {epoch}; continue with --resume {sweep.path}")
    for k, run in enumerate(sweep.runs):
        finish(run, tasks[run.config.env], job.learner.policy(job.member(states, k).learner))


def _tasks(sweep: Sweep, env: ReachEnv) -> dict[EnvConfig, Task]:
    """Return the tasks that evaluate the members, one for each environment."""
    configs = {run.config.env: run.config for run in sweep.runs}
    return {own: task_of(config, with_env_config(env, own)) for own, config in configs.items()}


def _start(sweep: Sweep, job: SweepJob, epoch: int) -> TrainState:
    """Return the state after an epoch; later checkpoints and metrics of the members are deleted."""
    for run in sweep.runs:
        run.rewind(epoch)
    if not epoch:
        return job.init()
    like = job.member_shapes()
    return job.together([run.restore(like)[1] for run in sweep.runs])


def _line(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the text of an epoch: speeds, and the range of the medians if the members were evaluated."""
    n, row = len(rows), rows[0]
    env_steps, updates = row["speed/env_steps_per_s"], row["speed/updates_per_s"]
    text = f"{n} x {env_steps:.0f} env steps/s  {n} x {updates:.0f} updates/s"
    if "evaluation/median_mm" not in row:
        return text
    medians = [row["evaluation/median_mm"] for row in rows]
    return f"{text}  held-out medians {np.min(medians):.1f} to {np.max(medians):.1f} mm"
