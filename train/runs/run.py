"""Host side of a training run: its task, and the loop over epochs that shows, logs, saves and stops."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from tensorboardX import SummaryWriter

from mjx_softarm._support.errors import InputError
from mjx_softarm._support.provenance import write_json
from mjx_softarm.env import ReachEnv
from mjx_softarm.env.reach import POOL_SEED
from mjx_softarm.mechanics.workspace import Pool
from train.agent.learner import LearnerConfig
from train.config import TrainConfig, name_of
from train.demos.demonstrations import Demonstrations
from train.epoch.job import Job, State
from train.runs.evaluate import Evaluator, PositionEvaluator
from train.runs.folder import EVALUATION_FILE, Run, sole_trainer


class Task(NamedTuple):
    """Job of a run, its evaluation, and what happens before each epoch."""

    job: Job
    evaluate: Evaluator | PositionEvaluator
    prepare: Callable[[State, int], State]  # state, number of epochs done -> state


def task_of(config: TrainConfig, env: ReachEnv, demonstrations: Demonstrations | None = None) -> Task:
    """Return the task of a run: to reach the whole workspace, or positions as an expert showed.

    Raises InputError if the learner needs demonstrations and has none.
    """
    epoch: Any = config.learner.make_epoch(env, demonstrations)
    if demonstrations is None:
        job = Job(epoch, FreshPoses(env, config))
        return Task(job, Evaluator(env, epoch.learner), lambda state, k: state)
    positions, first = demonstrations.positions, epoch.goals.of_stage(0)
    evaluate = PositionEvaluator(env, epoch.learner, positions=positions, first=first)

    def prepare(state: State, k: int) -> State:
        def errors_mm() -> tuple[float, ...]:
            return evaluate(epoch.learner.policy(state.learner))[0].error_mm

        return epoch.goals.prepare(state, k, errors_mm)

    return Task(Job(epoch), evaluate, prepare)


def task_of_run(run: Run) -> Task:
    """Return the task of a run; raise InputError if its demonstrations cannot be read."""
    return task_of(run.config, ReachEnv(run.spec, run.config.env, run.arm.s2r), run.demonstrations())


class FreshPoses:
    """Pools of poses that starts and goals are drawn from, each for some epochs of a run.

    A policy that is trained for long on one pool learns the pool by heart: after 41,000 gradient steps,
    `analytic` had 0.62 mm at the 16,384 poses of its pool and 0.79 mm at others. A thread draws the next pool
    while the epochs of this one run. Without `fresh_poses_epochs`, the environment's own pool serves all.
    """

    def __init__(self, env: ReachEnv, config: TrainConfig):
        self._pool, self._every = env.poses, config.fresh_poses_epochs
        self._n_pools = -(-config.learner.n_epochs // self._every) if self._every else 1
        self._seeds, self._thread = (POOL_SEED, config.seed), ThreadPoolExecutor(1)
        self._futures: dict[int, Future[Pool]] = {}  # by number of the pool

    def __call__(self, epoch: int) -> Pool:
        """Return the pool of an epoch; from the second call on, begin to draw the pool that follows it."""
        if not self._every:
            return self._pool()
        k = epoch // self._every
        needed = [k, k + 1] if k in self._futures and k + 1 < self._n_pools else [k]
        self._futures = {i: self._futures.get(i) or self._draw(i) for i in needed}
        return self._futures[k].result()

    def _draw(self, k: int) -> Future[Pool]:
        return self._thread.submit(self._pool.draw, (*self._seeds, k))


class Interrupted(Exception):
    """The user stopped the run; its state is saved."""


def train(run: Run, task: Task, console: Console) -> Any:
    """Train to the end of the run's config, from its newest checkpoint if it has one; return final figures.

    Raises as `train_together` does.
    """
    job, learner = task.job, run.config.learner

    def first() -> State:
        if run.checkpoints.latest is None:
            return job.init(jax.random.PRNGKey(run.config.seed))
        return run.checkpoints.restore(job.shapes())

    def begin() -> State:
        console.print(
            f"compiling an epoch of {learner.n_arms} arms with updates of {name_of(learner)} "
            "(cached for the next start) ..."
        )
        return job.start(first)

    (summary,) = train_together(job, [(run, task)], begin, run.path, console)
    return summary


def train_together(
    job: Any,
    members: Sequence[tuple[Run, Task]],
    begin: Callable[[], State],
    path: Path,
    console: Console,
    member: Callable[[State, int], State] = lambda state, k: state,
) -> list[Any]:
    """Train all members of one job, a run or the runs of a sweep, to their end; return their final figures.

    `begin` returns the state to begin with; later checkpoints and metrics are deleted. `member` takes the
    state of the k-th member from the job's. `--resume` continues the folder `path`.

    Raises:
        Interrupted: after Ctrl-C or a termination signal, once the state is saved.
        InputError: arms in motion diverge, or another process trains in the folder.
    """
    with sole_trainer(path):
        state = _train_epochs(job, members, begin, path, console, member)
        policies = [job.learner.policy(member(state, k).learner) for k in range(len(members))]
        return [finish(*each, policy) for each, policy in zip(members, policies, strict=True)]


def _train_epochs(
    job: Any,
    members: Sequence[tuple[Run, Task]],
    begin: Callable[[], State],
    path: Path,
    console: Console,
    member: Callable[[State, int], State],
) -> State:
    """Return the state after the last epoch, with the arguments of `train_together`."""
    (first, shared), learner = members[0], job.learner
    config, n_epochs = first.config, first.config.learner.n_epochs
    with asked_to_stop() as asked, ExitStack() as stack:
        state = begin()
        epoch = int(state.n_epochs)
        for run, _ in members:
            run.rewind(epoch)
        if epoch:
            console.print(f"continuing after epoch {epoch} of {n_epochs}")
        later = config.learner.n_env_steps(epoch) + 1 if epoch else None  # events that a stopped run has left
        boards = [stack.enter_context(SummaryWriter(str(run.path), purge_step=later)) for run, _ in members]
        show = stack.enter_context(shown_progress(config, epoch, console))
        while epoch < n_epochs:
            # Train an epoch. Metrics without an axis of members are the same for all.
            state, metrics = timed_epoch(job, shared.prepare(state, epoch), config.learner, epoch)
            rows = [
                {name: float(x[k] if np.ndim(x) else x) for name, x in metrics.items()}
                for k in range(len(members))
            ]
            epoch += 1
            stop, due = bool(asked), config.evaluates_after(epoch)
            # Evaluate, record and save each member.
            for k, ((run, task), board, row) in enumerate(zip(members, boards, rows, strict=True)):
                refuse_divergence(run.config, row["env/unsettled"])
                member_state = member(state, k) if due or stop else None
                if member_state is not None and due:
                    figures = task.evaluate(learner.policy(member_state.learner))[0].to_dict()
                    row |= {f"evaluation/{n}": x for n, x in figures.items() if not isinstance(x, tuple)}
                record(run, board, epoch, row)
                if member_state is not None:
                    run.checkpoints.save(epoch, member_state, learner.parts(member_state.learner))
            show(epoch, _line(rows, shared), due)
            if stop and epoch < n_epochs:
                raise Interrupted(f"stopped after epoch {epoch}; continue with --resume {path}")
    return state


def refuse_divergence(config: TrainConfig, n_unsettled: float) -> None:
    """Raise InputError where most of an epoch's actions of arms in motion led to no finite state."""
    n_actions = config.learner.n_env_steps(1)
    if config.env.in_motion and n_unsettled > n_actions / 2:
        raise InputError(
            f"env.simulation_step_s: got {config.env.simulation_step_s:g}, with which {n_unsettled:.0f} of "
            f"{n_actions} actions diverged, expected a shorter time step for this arm"
        )


def finish(run: Run, task: Task, policy: Any) -> Any:
    """Evaluate a policy, write `evaluation.json` and the pictures; returns the figures."""
    from train.runs import plots  # matplotlib takes half a second to import

    results: Any
    summary, *results = task.evaluate(policy)
    write_json(run.path / EVALUATION_FILE, summary.to_dict())
    plots.save(run.path, run.metrics(), summary, *results)
    return summary


def begin_with(task: Task, seed: int, donors: Mapping[str, Run]) -> tuple[State, dict[str, Any]]:
    """Return the state that a new run begins with, and its parts; some of these are another run's.

    Networks are those of the donor `agent`, the learned reward is that of the donor `reward`. Raises
    InputError for a donor without such a part, or with one of another size.
    """
    state, learner = task.job.init(jax.random.PRNGKey(seed)), task.job.learner
    for option, donor in donors.items():
        saved = donor.checkpoints.parts()
        parts = {name: x for name, x in saved.items() if (name == "reward") == (option == "reward")}
        if not parts:
            expected = "a run of `imitate` that learned one"
            raise InputError(f"{donor.path}: {option}: got none, expected {expected}")
        try:
            state = state._replace(learner=learner.adopt(state.learner, parts))
        except ValueError as error:
            raise InputError(f"{donor.path}: {error}") from error
    return state, learner.parts(state.learner)


def timed_epoch(job: Any, state: State, learner: LearnerConfig, epoch: int) -> tuple[State, dict[str, Any]]:
    """Return the next state of a job, and its metrics with the speeds of each member."""
    start = time.perf_counter()
    state, metrics = job.epoch(state)
    metrics = jax.device_get(metrics)
    seconds = time.perf_counter() - start
    n_updates = learner.n_updates(epoch + 1) - learner.n_updates(epoch)
    metrics["speed/env_steps_per_s"] = learner.n_env_steps(1) / seconds
    metrics["speed/updates_per_s"] = n_updates / seconds
    return state, metrics


def record(run: Run, board: SummaryWriter, epoch: int, row: dict[str, float]) -> None:
    """Add a row to the run's metrics and to TensorBoard's."""
    learner = run.config.learner
    env_steps = learner.n_env_steps(epoch)
    run.log({"epoch": epoch, "env_steps": env_steps, "updates": learner.n_updates(epoch), **row})
    for name, value in row.items():
        board.add_scalar(name, np.float32(value), env_steps)


def _line(rows: Sequence[dict[str, float]], task: Task) -> str:
    """Return the text of an epoch: speeds, success, and figures if the members were evaluated."""
    n, row, each = len(rows), rows[0], f"{len(rows)} x " if len(rows) > 1 else ""
    env_steps, updates = row["speed/env_steps_per_s"], row["speed/updates_per_s"]
    text = f"{each}{env_steps:.0f} env steps/s  {each}{updates:.0f} updates/s  {_success(rows)}"
    if "evaluation/median_mm" not in row:
        return text
    if n == 1:
        return f"{text}  {task.evaluate.headline(row)}"
    medians = [row["evaluation/median_mm"] for row in rows]
    return f"{text}  held-out medians {np.min(medians):.1f} to {np.max(medians):.1f} mm"


def _success(rows: Sequence[dict[str, float]]) -> str:
    """Return the text of the success in training, with exploration.

    Ends of episodes count, as in an evaluation: in motion, earlier actions are on the way. A learner with
    arms of its own has no episodes. There, all actions count.
    """
    if "env/episodes" in rows[0]:
        episodes, successes = (sum(row[f"env/{name}"] for row in rows) for name in ("episodes", "successes"))
        share = f"{100 * successes / episodes:.0f}" if episodes else "-"
        return f"exploring: success {share} % of episodes"
    return f"success {100 * np.mean([row['env/reached'] for row in rows]):.0f} % of actions"


@contextmanager
def shown_progress(
    config: TrainConfig, epoch: int, console: Console
) -> Iterator[Callable[[int, str, bool], None]]:
    """Yield a function of epoch, text and whether it was evaluated: it moves a bar, or prints a line."""
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    columns += (TextColumn("{task.fields[text]}"),)
    hidden = not console.is_terminal
    with Progress(*columns, console=console, speed_estimate_period=120, disable=hidden) as progress:
        bar = progress.add_task("training", total=config.learner.n_epochs, completed=epoch, text="")

        def show(epoch: int, text: str, due: bool) -> None:
            progress.update(bar, completed=epoch, text=text)
            if due and hidden:
                console.print(f"epoch {epoch} of {config.learner.n_epochs}: {text}")

        yield show


@contextmanager
def asked_to_stop() -> Iterator[list[int]]:
    """Yield the stop signals received, a list that grows; a second Ctrl-C stops at once."""
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


def free_path(base: Path) -> Path:
    """Return this path, or the first path numbered after it, that does not exist."""
    candidates = (base if k == 1 else base.with_name(f"{base.name}-{k}") for k in range(1, 10_000))
    return next(path for path in candidates if not path.exists())
