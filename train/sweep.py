"""Sweeps: seeds, and settings that are plain numbers, trained as one vmapped job.

The numbers in which the members differ are traced, so one compilation serves all members. They share one
count of epochs: a branch on a count of each member would compute both of its sides, and warm-up would cost as
much as learning. Each member has the folder of an ordinary run, and every command on a run works on it.
"""

from __future__ import annotations

import copy
import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jax import Array
from rich.console import Console
from rich.table import Table

from mjx_softarm._support import cli
from mjx_softarm._support.errors import InputError
from mjx_softarm._support.provenance import provenance, write_json
from mjx_softarm.env import ReachEnv
from mjx_softarm.mdp.rewards import RewardConfig
from train.config import TrainConfig, override
from train.epoch.job import Epoch, Job, State
from train.options import start
from train.runs.command import ReachOptions
from train.runs.evaluate import Summary
from train.runs.folder import CONFIG_FILE, EVALUATION_FILE, Run
from train.runs.run import FreshPoses, Interrupted, free_path, task_of, train_together

RESULTS_FILE = "results.json"


@dataclass(frozen=True, kw_only=True)
class Sweep(ReachOptions):
    """Train `reach` with several seeds and settings, all at once; they replace the settings' own values."""

    seeds: cli.Integers = (0,)
    """seeds of each setting"""
    vary: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="NAME=VALUE,...")] = ()
    """train with each of these numbers, e.g. learner.gamma=0.5,0.9; several: with each combination"""

    def __call__(self) -> int:
        console = start()
        # The members, of a folder or of these settings.
        if self.resume:
            self.check_resume_alone()
            path, runs = self.resume, open_members(self.resume)
            for run in (run for run in runs if run.checkpoints.latest is None):
                run.check_begins_anew()
        else:
            members = members_of(self.config, self.seeds, self.vary)
            path = self.out or free_path(Path("runs") / f"sweep-{self.preset}")
            if path.exists():
                raise InputError(f"--out: got {path}, which exists, expected a new folder, or --resume")
            arm, preset = self.read_arm(console), self.preset
            runs = [Run.create(path / name, members[name], arm, preset=preset) for name in sorted(members)]
        console.print(f"sweep: {path}, {len(runs)} members")
        # Train all of them, and report.
        try:
            train(path, runs, console)
        except Interrupted as stop:
            console.print(str(stop))
            return cli.INTERRUPTED
        console.print(report(path, runs), soft_wrap=False)
        console.print(f"results: {path / RESULTS_FILE}")
        return 0


def variable(config: TrainConfig) -> tuple[str, ...]:
    """Return the names of the settings in which members may differ: numbers of the learner and the reward."""
    rewards = (item.name for item in dataclasses.fields(RewardConfig) if not isinstance(item.default, tuple))
    numbers = {"learner": config.learner.VARIABLE, "env.reward": rewards}
    return tuple(f"{group}.{name}" for group, names in numbers.items() for name in names)


def members_of(config: TrainConfig, seeds: Sequence[int], vary: Sequence[str]) -> dict[str, TrainConfig]:
    """Return the configs of a sweep's members by names such as `seed0-learner.gamma=0.5`.

    Each seed comes with each combination of the varied numbers, each a NAME=VALUE,VALUE,... of `vary`.

    Raises:
        InputError: a setting is unknown or no number, or a value cannot be used or comes twice.
    """
    # Read the values of each varied number.
    values: dict[str, list[str]] = {}
    for assignment in vary:
        path, _, text = assignment.partition("=")
        path = path.replace("-", "_")
        if not text or path not in variable(config) or path in values:
            names = ", ".join(variable(config))
            raise InputError(f"--vary: got {assignment!r}, expected NAME=VALUE,... once for each of {names}")
        values[path] = [value.strip() for value in text.split(",")]
    # Make a config of each combination.
    members = {}
    for seed, *combination in itertools.product(seeds, *values.values()):
        changes = [f"{path}={text}" for path, text in zip(values, combination, strict=True)]
        member = override(config, [f"seed={seed}", *changes])
        for path in values:
            value = attrgetter(path)(member)
            if not isinstance(value, float):
                raise InputError(f"--vary {path}: got {value}, expected numbers")
        members["-".join([f"seed{seed}", *changes])] = member
    return members


def open_members(path: Path) -> list[Run]:
    """Return the runs in the folder of a sweep, by name; raise InputError if there are none."""
    runs = [Run.open(file.parent) for file in sorted(path.glob(f"*/{CONFIG_FILE}"))]
    if not runs:
        raise InputError(f"{path}: got no folder of a run in it, expected the folder of a sweep")
    return runs


def differing(runs: Sequence[Run]) -> dict[str, list[float]]:
    """Return the numbers in which runs differ besides their seeds, with the value of each run."""
    values = {name: [attrgetter(name)(run.config) for run in runs] for name in variable(runs[0].config)}
    return {name: numbers for name, numbers in values.items() if len(set(numbers)) > 1}


class MembersState(NamedTuple):
    """States of all members, with an axis of members in front, and the numbers in which they differ."""

    members: State  # all leaves but `n_epochs` are (n, ...)
    numbers: dict[str, Array]  # (n,) by name

    @property
    def n_epochs(self) -> Array:
        return self.members.n_epochs

    def member(self, k: int) -> State:
        """Return the state of one member, as an ordinary run has it."""
        return jax.tree.map(lambda x: x[k] if x.ndim else x, self.members)


class MembersEpoch:
    """`Epoch` of all members, each with its own config, which holds traced numbers."""

    def __init__(self, config: TrainConfig, env: ReachEnv):
        one = config.learner.make_epoch(env)
        self.config, self.env, self.kind, self.learner = config, env, one.kind, one.learner

    def first(self, key: tuple[Array, dict[str, Array]]) -> MembersState:
        """Return the first states of members, from their keys (n, 2) and numbers (n,)."""
        keys, numbers = key
        members = jax.vmap(lambda key, numbers: self._epoch(numbers).first(key))(keys, numbers)
        return MembersState(members._replace(n_epochs=members.n_epochs[0]), numbers)

    def advance(self, state: MembersState) -> tuple[MembersState, dict[str, Array]]:
        """Return the states after an epoch, and metrics (n,)."""
        axes = type(state.members)(*[0] * len(state.members))._replace(n_epochs=None)
        advance = lambda member, numbers: self._epoch(numbers).advance(member)  # noqa: E731
        vmapped = jax.vmap(advance, in_axes=(axes, 0), out_axes=(axes, 0))
        members, metrics = vmapped(state.members, state.numbers)
        return state._replace(members=members), metrics

    def _epoch(self, numbers: Mapping[str, Array]) -> Epoch:
        config = self.config
        for path, number in numbers.items():
            config = _with_number(config, path, number)
        return config.learner.make_epoch(with_config(self.env, config))


def _with_number(config: Any, path: str, number: Array) -> Any:
    """Return a copy of a config with a traced number; its checks need values, and have passed before."""
    name, _, rest = path.partition(".")
    changed = copy.copy(config)
    value = _with_number(getattr(config, name), rest, number) if rest else number
    object.__setattr__(changed, name, value)  # the class is frozen
    return changed


def with_config(env: ReachEnv, config: TrainConfig) -> ReachEnv:
    """Return the environment with a config that differs in its reward alone."""
    other = copy.copy(env)
    other.config = config.env
    return other


def train(path: Path, runs: Sequence[Run], console: Console) -> None:
    """Train all members to their end, from the newest checkpoints that they have in common."""
    console.print("drawing goals from the reachable workspace ...")
    configs = [run.config for run in runs]
    env = ReachEnv(runs[0].spec, configs[0].env, runs[0].arm.s2r)
    job = Job(MembersEpoch(configs[0], env), FreshPoses(env, configs[0]))
    keys = jnp.stack([jax.random.PRNGKey(config.seed) for config in configs])
    numbers = {name: jnp.asarray(x, jnp.float32) for name, x in differing(runs).items()}
    tasks = {config.env: task_of(config, with_config(env, config)) for config in configs}

    def begin() -> MembersState:
        # Continue from the newest epoch that all members have a checkpoint of.
        epoch = max(set.intersection(*(set(run.checkpoints.epochs) for run in runs)), default=0)
        console.print("compiling (cached for the next start) ...")
        if not epoch:
            return job.init((keys, numbers))
        like = jax.eval_shape(lambda state: state.member(0), job.shapes((keys, numbers)))
        members = [run.checkpoints.restore(like, epoch) for run in runs]
        states = jax.tree.map(lambda *x: jnp.stack(x), *members)._replace(n_epochs=members[0].n_epochs)
        return MembersState(states, numbers)

    members = [(run, tasks[run.config.env]) for run in runs]
    train_together(job, members, begin, path, console, MembersState.member)


def report(path: Path, runs: Sequence[Run]) -> Table:
    """Write the results of a sweep into its folder; return their table: mean and range over the seeds."""
    # Group the figures of the members by their settings.
    groups: dict[str, list[dict[str, Any]]] = {}
    numbers = differing(runs)
    for k, run in enumerate(runs):
        figures = run.evaluation()
        if figures is None:
            raise InputError(f"{run.path}: got no {EVALUATION_FILE}, expected a finished run")
        name = "\n".join(f"{path}={values[k]:g}" for path, values in numbers.items())
        groups.setdefault(name, []).append({"seed": run.config.seed, **figures})
    write_json(path / RESULTS_FILE, {"groups": groups, "provenance": provenance("train")})
    # Show mean, least and greatest of each group, in a column.
    table = Table("mean (least to greatest)", *groups, title="held-out figures", title_justify="left")
    for item in dataclasses.fields(Summary):
        label, unit, decimals = item.metadata["row"]
        values = [[row[item.name] for row in rows if item.name in row] for rows in groups.values()]
        if all(values):
            scaled = [(100 if unit == "%" else 1) * np.array(group) for group in values]
            ranges = [[f"{f(group):.{decimals}f}" for f in (np.mean, np.min, np.max)] for group in scaled]
            table.add_row(f"{label} {unit}", *(f"{mean} ({low} to {high})" for mean, low, high in ranges))
    return table
