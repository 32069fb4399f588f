"""Host side of a training run: loop over epochs, show, log, checkpoint, stop on request."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from tensorboardX import SummaryWriter

from mjx_softarm._support.provenance import write_json
from mjx_softarm.env import ReachEnv
from train.agent.learner import LearnerConfig
from train.config import TrainConfig
from train.epoch.devices import any_process, is_first_process
from train.epoch.job import TrainState
from train.runs import plots
from train.runs.checkpoint import Run, RunError
from train.runs.task import Task, task_of


class Interrupted(Exception):
    """The user stopped the run; its state is saved."""


def train(run: Run, task: Task, console: Console) -> Any:
    """Train to the end of the run's config, from its newest checkpoint if it has one.

    Args:
        run: the folder, with all settings.
        task: task of the run.
        console: shows progress.

    Returns:
        Figures of the final policy.

    Raises:
        Interrupted: after Ctrl-C or a termination signal, once the state is saved.
        RunError: arms in motion diverge.
    """
    config = run.config
    with asked_to_stop() as asked:
        epoch, state = _begin(run, task, console)
        run.rewind(epoch)
        with open_board(run, epoch) as board, shown_progress(config, epoch, console) as show:
            while epoch < config.learner.n_epochs:
                state, metrics = timed_epoch(task.job, task.prepare(state, epoch), config.learner, epoch)
                row = {name: float(value) for name, value in metrics.items()}
                epoch += 1
                refuse_divergence(config, row["env/unsettled"])
                stop, due = any_process(bool(asked)), config.evaluates_after(epoch)
                if due:
                    row |= evaluation(run, task, task.job.policy(state))
                record(run, board, epoch, row)
                if due or stop:
                    run.save(epoch, state, task.job.parts(state))
                show(epoch, _line(task, row), due)
                if stop and epoch < config.learner.n_epochs:
                    raise Interrupted(f"stopped after epoch {epoch}; continue with --resume {run.path}")
    return finish(run, task, task.job.policy(state))


def refuse_divergence(config: TrainConfig, n_unsettled: float) -> None:
    """Raise RunError where most of an epoch's actions of arms in motion led to no finite state."""
    n_actions = config.learner.n_env_steps(1)
    if config.env.moves and n_unsettled > n_actions / 2:
        raise RunError(
            f"env.simulation_step_s: got {config.env.simulation_step_s:g}, with which {n_unsettled:.0f} of "
            f"{n_actions} actions diverged, expected a shorter time step for this arm"
        )


def _begin(run: Run, task: Task, console: Console) -> tuple[int, TrainState]:
    """Return the number of epochs that a run has done, and its state after them."""
    console.print("compiling (cached for the next start) ...")

    def first() -> tuple[int, TrainState]:
        if run.latest_epoch is None:
            return 0, task.job.init(jax.random.PRNGKey(run.config.seed))
        return run.restore(task.job.like())

    epoch, state = task.job.start(first)
    if epoch:
        console.print(f"continuing after epoch {epoch} of {run.config.learner.n_epochs}")
    return epoch, state


def finish(run: Run, task: Task, policy: Any) -> Any:
    """Evaluate a policy, write `evaluation.json` and the pictures; returns the figures."""
    summary, *reached = task.evaluate(policy)
    if is_first_process():
        run.write_poses(*reached)
        write_json(run.path / "evaluation.json", summary.to_dict())
        plots.save(run.path, task.pictures(run.metrics(), *reached))
    return summary


def task_of_run(run: Run, mesh: Mesh | None = None) -> Task:
    """Return the task of a run.

    Raises:
        RunError: its demonstrations cannot be read.
        ConfigError: it cannot be split evenly over the devices of the mesh.
    """
    return task_of(run.config, ReachEnv(run.spec, run.config.env, run.s2r), run.demonstrations(), mesh)


def begin_with(task: Task, seed: int, donors: Mapping[str, Run]) -> tuple[TrainState, dict[str, Any]]:
    """Return the state that a new run begins with, and its parts; some of these are another run's.

    Args:
        task: task of the new run.
        seed: seed of the new run.
        donors: `agent`: run whose networks are taken; `reward`: run whose learned reward is taken.

    Raises:
        RunError: a donor has no such part, or one of another size.
    """
    state, learner = task.job.init(jax.random.PRNGKey(seed)), task.job.learner
    for option, donor in donors.items():
        parts = {name: x for name, x in donor.parts().items() if (name == "reward") == (option == "reward")}
        if not parts:
            expected = "a run of `imitate` that learned one"
            raise RunError(f"{donor.path}: {option}: got none, expected {expected}")
        try:
            state = state._replace(learner=learner.adopt(state.learner, parts))
        except ValueError as error:
            raise RunError(f"{donor.path}: {error}") from error
    return (state := task.job.place(state)), task.job.parts(state)


def open_board(run: Run, epoch: int) -> SummaryWriter:
    """Return TensorBoard's writer; events of a stopped run later than an epoch are dropped."""
    purge_step = run.config.learner.n_env_steps(epoch) + 1 if epoch else None
    return SummaryWriter(str(run.path), purge_step=purge_step, write_to_disk=is_first_process())


def timed_epoch(
    job: Any, state: TrainState, learner: LearnerConfig, epoch: int
) -> tuple[TrainState, dict[str, Any]]:
    """Return the next state of a job, or of a sweep's, and its metrics with the speeds of one run."""
    start = time.perf_counter()
    state, metrics = job.epoch(state)
    metrics = jax.device_get(metrics)
    seconds, before = time.perf_counter() - start, counts(learner, epoch)
    done = {name: n - before[name] for name, n in counts(learner, epoch + 1).items()}
    return state, metrics | {f"speed/{name}_per_s": n / seconds for name, n in done.items()}


def evaluation(run: Run, task: Task, policy: Any) -> dict[str, float]:
    """Return the figures of a policy, named as in a row of metrics; its poses go into the run's folder."""
    summary, *results = task.evaluate(policy)
    run.write_poses(*results)
    figures = summary.to_dict()
    return {f"evaluation/{name}": x for name, x in figures.items() if not isinstance(x, tuple)}


def counts(learner: LearnerConfig, epoch: int) -> dict[str, int]:
    """Return the numbers of env steps and updates by the end of an epoch, named as in a row of metrics."""
    return {"env_steps": learner.n_env_steps(epoch), "updates": learner.n_updates(epoch)}


def record(run: Run, board: SummaryWriter, epoch: int, row: dict[str, float]) -> None:
    """Add a row to the run's metrics and to TensorBoard's."""
    done = counts(run.config.learner, epoch)
    run.log({"epoch": epoch, **done, **row})
    for name, value in row.items():
        board.add_scalar(name, np.float32(value), done["env_steps"])


def _line(task: Task, row: dict[str, float]) -> str:
    text = (
        f"{row['speed/env_steps_per_s']:.0f} env steps/s  {row['speed/updates_per_s']:.0f} updates/s  "
        f"success {100 * row['env/reached']:.0f} % of actions"
    )
    return f"{text}  {task.headline(row)}" if "evaluation/median_mm" in row else text


@contextmanager
def shown_progress(
    config: TrainConfig, epoch: int, console: Console
) -> Iterator[Callable[[int, str, bool], None]]:
    """Yield a function that shows an epoch with its text on a bar, or, if due, as a line of a file."""
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    columns += (TextColumn("{task.fields[text]}"),)
    hidden = not console.is_terminal
    with Progress(*columns, console=console, speed_estimate_period=120, disable=hidden) as progress:
        bar = progress.add_task("training", total=config.learner.n_epochs, completed=epoch, text="")

        def show(epoch: int, text: str, due: bool) -> None:
            progress.update(bar, completed=epoch, text=text)
            if due and hidden:
                console.print(f"epoch {epoch} of {config.learner.n_epochs}: {text}", highlight=False)

        yield show


@contextmanager
def asked_to_stop() -> Iterator[list[int]]:
    """Yield a list that fills when the process is asked to stop; a second Ctrl-C stops at once."""
    asked: list[int] = []

    def note(number: int, _frame: Any) -> None:
        if asked and number == signal.SIGINT:
            raise KeyboardInterrupt
        asked.append(number)

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def default_path(task: str, preset: str, seed: int) -> Path:
    """Return `runs/TASK-PRESET-seedN`, or the first free path numbered after it."""
    return free_path(Path("runs") / f"{task}-{preset}-seed{seed}")


def free_path(base: Path) -> Path:
    """Return this path, or the first path numbered after it, that does not exist."""
    candidates = (base if k == 1 else base.with_name(f"{base.name}-{k}") for k in range(1, 10_000))
    return next(path for path in candidates if not path.exists())
