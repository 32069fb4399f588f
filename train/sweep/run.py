"""Host side of a sweep: its folder, and the loop that trains all members at once.

Each member has the folder of an ordinary run, and every command on a run works on a member. After a killed
process the members may have checkpoints of different epochs; they continue from the newest common one.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from calib.arm import CalibratedArm
from mjx_softarm._support.provenance import provenance, write_json
from mjx_softarm.env import EnvConfig, ReachEnv
from train.config import TrainConfig
from train.epoch.state import TrainState
from train.runs.checkpoint import RunError
from train.runs.folder import Run
from train.runs.run import train_together
from train.runs.task import Task, task_of
from train.sweep.job import SweepJob, check_delays, with_env_config

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
        return max(set.intersection(*(set(run.checkpoints.epochs) for run in self.runs)), default=0)


def create(
    path: Path,
    members: Mapping[str, TrainConfig],
    varied: Sequence[str],
    arm: CalibratedArm,
    preset: str | None = None,
) -> Sweep:
    """Start the folder of a sweep, whole or not at all.

    Args:
        path: folder to make.
        members: configs by the names of their folders.
        varied: settings in which the members differ, besides their seeds.
        arm: the arm, calibrated or not.
        preset: name of the settings that the members' began with, if they have one.

    Raises:
        RunError: there is such a folder already, or it cannot be made.
        ConfigError: dead times of the members differ too much.
    """
    check_delays(arm.spec, list(members.values()))
    # Make the members' folders beside the final one, and rename the whole at the end.
    if path.exists():
        expected = f"a new folder; --resume {path} continues this one"
        raise RunError(f"--out: got {path}, which is there already, expected {expected}")
    part = path.with_name(path.name + ".part")
    shutil.rmtree(part, ignore_errors=True)  # left by a start that was interrupted
    for name, config in members.items():
        Run.create(part / name, config, arm, preset=preset)
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
        RunError: arms in motion diverge.
    """
    console.print("drawing goals from the reachable workspace ...")
    run = sweep.runs[0]
    env = ReachEnv(run.spec, run.config.env, run.arm.s2r)
    job, tasks = SweepJob([run.config for run in sweep.runs], sweep.varied, env), _tasks(sweep, env)

    def begin() -> tuple[int, TrainState]:
        epoch = sweep.epoch
        for run in sweep.runs:
            run.rewind(epoch)
        console.print("compiling (cached for the next start) ...")
        if not epoch:
            return 0, job.init()
        like = job.member_shapes()
        return epoch, job.together([run.checkpoints.restore(like)[1] for run in sweep.runs])

    members = [(run, tasks[run.config.env]) for run in sweep.runs]
    train_together(job, members, begin, sweep.path, console)


def _tasks(sweep: Sweep, env: ReachEnv) -> dict[EnvConfig, Task]:
    """Return the tasks that evaluate the members, one for each environment."""
    configs = {run.config.env: run.config for run in sweep.runs}
    return {own: task_of(config, with_env_config(env, own)) for own, config in configs.items()}
