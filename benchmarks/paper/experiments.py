"""Command `python -m benchmarks paper`: the stages of each experiment, in their order, and its report."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from benchmarks.harness.common import RESULTS, names_of, show, status_of
from benchmarks.harness.stages import WorkStage, claim, run_stages
from benchmarks.paper import independence, jobs
from benchmarks.paper.report import printed_rows, write_report
from benchmarks.paper.trials import (
    BESIDE,
    CALIBRATION,
    EVALUATION_FILE,
    EXPERIMENTS,
    KINDS,
    MORE,
    POLICY_FILE,
    SMOKE,
    PolicyKey,
    Settings,
    arm_name,
    arms_and_seeds,
    demonstrations_path,
    pipe_policies,
    run_path,
    s2r_path,
    traced,
    trials,
)
from mjx_softarm._support import cli
from mjx_softarm._support.errors import InputError


@dataclass(frozen=True)
class Paper:
    """How close does the paper's method come on simulated stand-ins for an arm? Takes hours.

    The exit status is 1 if a target is missed.

    Results stay in the working folder: the same command continues, and twins, seeds, loads and presets may be
    added.

    Args:
        smoke: run everything, but tiny; says nothing about the arm
        only: one experiment; None: all
        twins: which twins; None: 0,1,2
        seeds: of training; None: 0,1,2
        loads: payloads in open space [g]; None: 35,105,220,330,500,1000
        arm: twin, or a rod, of other physics, in open space alone
        beside: further presets in open space, beside analytic
        out: working folder; None: runs/paper
    """

    smoke: bool = False
    only: Literal["open", "confined", "independence"] | None = None
    twins: cli.Integers | None = None
    seeds: cli.Integers | None = None
    loads: cli.Integers | None = None
    arm: Literal["twin", "rod"] = "twin"
    beside: Annotated[tuple[str, ...], names_of(BESIDE)] = ()
    out: cli.MaybePath = None

    def __call__(self) -> int:
        """Run the experiments, print and write their figures; return the exit status."""
        settings = self.settings()
        folder = self.out or Path("runs/paper-smoke" if self.smoke else "runs/paper")
        status = 0
        for experiment in [self.only] if self.only else EXPERIMENTS:
            data = run(experiment, folder, folder if self.smoke else RESULTS, settings)
            show({"means": printed_rows(experiment, data), "targets": data.get("targets", [])}, experiment)
            status |= status_of(data)
        return 0 if self.smoke else status

    def settings(self) -> Settings:
        """Return the settings that these options choose.

        Raises:
            InputError: the options do not go together.
        """
        if self.only != "open" and self.arm == "rod":
            raise InputError(f"--only: got {self.only}, expected open with --arm rod")
        if self.beside and self.smoke:
            raise InputError(f"--beside: got {','.join(self.beside)}, expected none with --smoke")
        given = {"twins": self.twins, "seeds": self.seeds, "loads_g": self.loads}
        chosen = {name: value for name, value in given.items() if value is not None}
        size = SMOKE if self.smoke else Settings()
        return dataclasses.replace(size, arm=self.arm, beside=self.beside, **chosen)


def run(experiment: str, folder: Path, results: Path, settings: Settings) -> dict[str, Any]:
    """Run the stages of an experiment that are not done and write its report; return the figures.

    Raises:
        InputError: a stage failed, or the folder has other settings or files of an older version.
    """
    claim(folder, settings, MORE)
    run_stages(folder, settings, stages(experiment, settings))
    return write_report(experiment, folder, results, settings)


def stages(experiment: str, settings: Settings) -> list[list[WorkStage]]:
    """Return the stages of an experiment, group by group."""
    if experiment == "independence":
        policies = (*independence.POLICIES, independence.SOLVER)
        return [[_independence(name, settings) for name in policies]]
    calibrations = [
        WorkStage(f"log and calibrate twin {t}", (f"{arm_name(t)}/{CALIBRATION}",), jobs.calibrate_twin, (t,))
        for t in settings.twins
    ]
    compared = [
        WorkStage(f"S2R as printed and ours, twin {t}", (s2r_path(t),), jobs.compare_s2r, (t,))
        for t in settings.twins
        if experiment == "open"
    ]
    kept = traced(settings)
    tried = [
        WorkStage(
            f"try {trial.kind}, twin {trial.twin}, seed {trial.seed}, {trial.variant}",
            (trial.result, *([trial.log] if trial in kept else [])),
            jobs.try_out,
            (trial,),
        )
        for trial in trials(experiment, settings)
    ]
    learning = _open_learning if experiment == "open" else _confined_learning
    return [calibrations, compared, *learning(settings), tried]


def _independence(name: str, settings: Settings) -> WorkStage:
    files = independence.results_of(name, settings.seeds)
    return WorkStage(f"independence: {name}", files, independence.measure, (name,))


def _open_learning(settings: Settings) -> list[list[WorkStage]]:
    """Return the stages that train and export the policies of open space."""
    chambers = [("chambers", twin, settings.seeds[0]) for twin in settings.twins]
    kinds = ("with", *settings.beside)
    others = [*((kind, *run) for kind in kinds for run in arms_and_seeds(settings)), *chambers]
    nominal = [("specified", None, seed) for seed in settings.seeds]
    return [
        [_learn(jobs.train, *key) for key in (*nominal, *others)],
        [
            _export(None, [run_path(*key) for key in nominal]),
            *(_export(twin, _runs_of(twin, others)) for twin in settings.twins),
        ],
    ]


def _confined_learning(settings: Settings) -> list[list[WorkStage]]:
    """Return the stages that demonstrate, train and export the policies of pipes.

    A policy that takes another's reward is trained after it.
    """
    policies = pipe_policies(settings)
    tasks = dict.fromkeys((twin, KINDS[kind].task) for kind, twin, _ in policies)
    demonstrations = [
        WorkStage(f"{task}, twin {twin}", (demonstrations_path(twin, task),), jobs.demonstrate, (twin, task))
        for twin, task in tasks
    ]
    return [
        demonstrations,
        [_learn(jobs.imitate, *key) for key in policies if not KINDS[key[0]].reward_of],
        [_learn(jobs.imitate, *key) for key in policies if KINDS[key[0]].reward_of],
        [_export(twin, _runs_of(twin, policies)) for twin in settings.twins],
    ]


def _runs_of(twin: int, policies: Iterable[PolicyKey]) -> list[str]:
    return [run_path(*key) for key in policies if key[1] == twin]


def _learn(job: Any, kind: str, twin: int | None, seed: int) -> WorkStage:
    result = f"{run_path(kind, twin, seed)}/{EVALUATION_FILE}"
    return WorkStage(f"train {kind}, {arm_name(twin)}, seed {seed}", (result,), job, (kind, twin, seed))


def _export(twin: int | None, runs: list[str]) -> WorkStage:
    policies = tuple(f"{run}/{POLICY_FILE}" for run in runs)
    return WorkStage(f"export for {arm_name(twin)}", policies, jobs.export, (twin, tuple(runs)))
