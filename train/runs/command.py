"""Commands `python -m train reach | imitate | evaluate`."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self, cast

import tyro
from rich.console import Console
from rich.table import Table

from mjx_softarm._support import cli
from mjx_softarm._support.errors import InputError
from mjx_softarm._support.provenance import write_json
from mjx_softarm.env import ReachEnv
from mjx_softarm.env.config import ENGINES
from train.agent.imitation import ImitationConfig
from train.config import LEARNERS, TrainConfig, name_of
from train.demos.demonstrations import from_log, read_demonstrations
from train.options import ArmOptions, start
from train.presets import IMITATION_PRESETS, PRESETS, preset_of
from train.runs import run as runs
from train.runs.evaluate import N_ACTIONS
from train.runs.folder import Run


@dataclass(frozen=True, kw_only=True)
class NewRunOptions(ArmOptions):
    """Options of a command that makes a folder, or continues one."""

    out: cli.MaybePath = None
    """new folder; None: a name in runs/ after the preset"""
    resume: cli.MaybePath = None
    """folder to continue; its own settings hold"""

    def check_resume_alone(self) -> None:
        """Raise InputError for settings beside `--resume`: those that differ from the command's own."""
        command: Any = self  # each has `config` and `default`
        new = command.default([])
        names = _differing(command, new, ("resume", "config")) + _differing(command.config, new.config)
        if names:
            given = ", ".join(f"--{name}" for name in dict.fromkeys(names))
            raise InputError(f"--resume {self.resume}: got {given} too, expected none: its own settings hold")


@dataclass(frozen=True, kw_only=True)
class ReachOptions(NewRunOptions):
    """Options of a command that trains policies which reach poses of the workspace."""

    preset: Annotated[str, cli.one_of(PRESETS)] = "quick"
    """settings to begin with; the defaults below are this preset's"""
    size: Literal["cpu", "gpu"] = "cpu"
    """machine that the preset's numbers of arms, steps and transitions suit; gpu: of analytic and motion"""
    learner: Annotated[str, cli.one_of(n for n, c in LEARNERS.items() if not c.FROM_DEMONSTRATIONS)] = "tqc"
    """learner; where it is not the preset's, it begins with its own defaults"""
    config: Annotated[TrainConfig, tyro.conf.arg(name="")]

    @classmethod
    def default(cls, arguments: Sequence[str]) -> Self:
        preset = _named(arguments, "--preset", PRESETS, "quick")
        size: Any = _named(arguments, "--size", ("cpu", "gpu"), "cpu")
        config = preset_of(preset, size)
        preset_learner = name_of(config.learner)
        learner = _named(arguments, "--learner", LEARNERS, preset_learner)
        if learner != preset_learner:
            config = dataclasses.replace(config, learner=LEARNERS[learner]())
        return cls(preset=preset, size=size, learner=learner, config=config)


@dataclass(frozen=True, kw_only=True)
class Reach(ReachOptions):
    """Train a policy that reaches poses of the workspace."""

    agent: cli.MaybePath = None
    """run whose policy this one begins with: one of TQC, with its critics; for analytic any run. The widths
    of its hidden layers are taken, too"""

    def __call__(self) -> int:
        console = start()
        if self.resume:
            return _resume(self, self.resume, console)
        return _begin("reach", self, self.config, {"agent": self.agent}, console)


@dataclass(frozen=True, kw_only=True)
class Imitate(NewRunOptions):
    """Train a policy from demonstrated poses.

    With a pipe, the evaluation counts poses whose body is not inside it.
    """

    file: tyro.conf.Positional[cli.MaybePath] = None
    """demonstrations as `demos record` writes them"""
    preset: Annotated[str, cli.one_of(IMITATION_PRESETS)] = "pipe"
    """settings to begin with. pipe: the learned reward; circle: the learned reward and the environment's, in
    two stages; paper-circle, paper-pipe: the paper's own recipe"""
    config: Annotated[TrainConfig, tyro.conf.arg(name="")]
    agent: cli.MaybePath = None
    """run whose actor and critics this one begins with. The widths of its hidden layers are taken, too"""
    reward: cli.MaybePath = None
    """run whose learned reward this one uses without training it"""

    @classmethod
    def default(cls, arguments: Sequence[str]) -> Self:
        preset = _named(arguments, "--preset", IMITATION_PRESETS, "pipe")
        return cls(preset=preset, config=IMITATION_PRESETS[preset])

    def __call__(self) -> int:
        console = start()
        if self.resume:
            return _resume(self, self.resume, console)
        if self.file is None:
            raise InputError("FILE: got nothing, expected the demonstrations, or --resume RUN")
        learner = cast(ImitationConfig, self.config.learner)
        if self.reward and not learner.learned_weight:
            raise InputError(
                f"learner.learned_weight: got 0 with --reward {self.reward}, expected more, for its reward"
            )
        learner = dataclasses.replace(learner, frozen=self.reward is not None)
        config = dataclasses.replace(self.config, learner=learner)
        donors = {"agent": self.agent, "reward": self.reward}
        return _begin("imitate", self, config, donors, console, self.file)


def _differing(one: Any, other: Any, ignored: Sequence[str] = ()) -> list[str]:
    names = [item.name for item in dataclasses.fields(one)]
    return [name for name in names if name not in ignored and getattr(one, name) != getattr(other, name)]


def _named(arguments: Sequence[str], option: str, names: Iterable[str], default: str) -> str:
    """Return the name that an option has among the words of a command line, or the default without one."""
    words = [part for word in arguments for part in word.split("=", 1)]
    name = dict(itertools.pairwise(words)).get(option, default)
    return name if name in names else default  # an unknown one is refused as all options are read


def evaluate(
    run: tyro.conf.Positional[Path],
    payload: float = 0.0,
    in_motion: float | None = None,
    actions: int | None = None,
) -> int:
    """Evaluate a run's newest policy, with figures and pictures.

    Args:
        run: folder of the run
        payload: mass to add to the specification's payload, at goals that the arm reaches with it; without
            pictures [g]
        in_motion: evaluate on arms in motion, with actions of this duration; without pictures [s]
        actions: number of actions towards each goal, in motion; None: 4
    """
    if not 0.0 <= payload < math.inf:
        raise InputError(f"--payload: got {payload:g}, expected a finite number >= 0")
    if actions is not None and (actions < 1 or in_motion is None):
        where = " without --in-motion" if in_motion is None else ""
        raise InputError(f"--actions: got {actions}{where}, expected a positive number with --in-motion")
    # Evaluate under the run's own conditions, with pictures, unless others are asked for.
    n_actions = actions or N_ACTIONS
    console = start()
    opened = Run.open(run)
    if in_motion is not None and opened.demonstrations():
        raise InputError("--in-motion: got a run of `imitate`, expected one of `reach`")
    task, policy = runs.task_of_run(opened), opened.policy()
    if in_motion is None and not payload:
        _show(opened, task, runs.finish(opened, task, policy), console)
        return 0
    # Name the other conditions in the table's title and in the file.
    config, how, name = opened.config.env, f"{n_actions} actions each", "evaluation"
    if payload:
        how, name = f"{how}, {payload:g} g", f"{name}-{payload:g}g"
    if in_motion is not None:
        engine = config.engine if config.engine in ENGINES["dynamic"] else "mjx"
        config = dataclasses.replace(config, engine=engine, mode="dynamic", dynamic_step_s=in_motion)
        how, name = (
            f"{how}, {in_motion:g} s an action, in motion",
            f"{name}-in-motion-{n_actions}x{in_motion:g}s",
        )
    # Evaluate under them.
    spec = opened.spec.replace(mass={"payload_kg": opened.spec.mass.payload_kg + 1e-3 * payload})
    env = ReachEnv(spec, config, opened.arm.s2r)
    summary, *_ = dataclasses.replace(task.evaluate, env=env, n_actions=n_actions)(policy)
    _table(f"{task.evaluate.title}, {how}", summary, console)
    file = opened.path / f"{name}.json"
    write_json(file, summary.to_dict())
    console.print(f"written: {file}")
    return 0


def _begin(
    command: str,
    options: Reach | Imitate,
    config: TrainConfig,
    donors: Mapping[str, Path | None],
    console: Console,
    demonstrations: Path | None = None,
) -> int:
    """Make a run and train it to its end; returns the exit status.

    `donors` are folders of runs that the new one takes parts of, by the options `agent` and `reward`.
    """
    # The arm, the demonstrations, and the runs that the new one begins with.
    arm = options.read_arm(console)
    log = None if demonstrations is None else read_demonstrations(demonstrations, arm.spec)[0]
    opened = {name: Run.open(path) for name, path in donors.items() if path}
    if "agent" in opened:
        config = config.with_policy_of(opened["agent"].config)
    # The task, the first state, and the run.
    console.print("drawing goals from the reachable workspace ...")
    env = ReachEnv(arm.spec, config.env, arm.s2r)
    if env.spec != arm.spec:
        n, n_specified = (spec.structure.links_per_section for spec in (env.spec, arm.spec))
        console.print(f"the arm has {n} links per section in this run, {n_specified} in its specification")
    task = runs.task_of(config, env, None if log is None else from_log(log, arm.spec))
    first = runs.begin_with(task, config.seed, opened) if opened else None
    path = options.out or runs.free_path(Path("runs") / f"{command}-{options.preset}-seed{config.seed}")
    begins_with = {name: run.path for name, run in opened.items()}
    run = Run.create(path, config, arm, log, begins_with, first, options.preset)
    return _train(run, task, console)


def _resume(options: Reach | Imitate, path: Path, console: Console) -> int:
    options.check_resume_alone()
    run = Run.open(path)
    if run.checkpoints.latest is None:
        run.check_begins_anew()
        console.print(f"{path}: no checkpoint yet, the run begins anew")
    return _train(run, runs.task_of_run(run), console)


def _train(run: Run, task: runs.Task, console: Console) -> int:
    console.print(f"run: {run.path}")
    try:
        summary = runs.train(run, task, console)
    except runs.Interrupted as stop:
        console.print(str(stop))
        return cli.INTERRUPTED
    _show(run, task, summary, console)
    return 0


def _show(run: Run, task: runs.Task, summary: Any, console: Console) -> None:
    _table(f"{task.evaluate.title}, {N_ACTIONS} actions each", summary, console)
    for picture in sorted(run.path.glob("*.png")):
        console.print(f"picture: {picture}")


def _table(title: str, summary: Any, console: Console) -> None:
    table = Table("figure", title=title, title_justify="left")
    table.add_column("value", justify="right")
    for row in summary.rows():
        table.add_row(*row)
    console.print(table, soft_wrap=False)
