"""How close does the paper's method come on simulated stand-ins for an arm?

The paper's experiments, in open space and in confined spaces: `python -m benchmarks paper`.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from benchmarks.harness.common import RESULTS, names_of, show, status_of
from benchmarks.paper.engine import SMOKE, Settings, claim, run_stages
from benchmarks.paper.kinds import BESIDE
from benchmarks.paper.report import json_name, printed_rows, write_report
from benchmarks.paper.summary import load_results
from benchmarks.paper.trials import FILMS, stages
from mjx_softarm._support import cli
from mjx_softarm._support.errors import InputError


@dataclass(frozen=True)
class Paper:
    """How close does the paper's method come on simulated stand-ins for an arm? Takes hours.

    The exit status is 1 if a target is missed.

    Results stay in the working folder: the same command continues, and twins or seeds may be added.

    Args:
        smoke: run everything, but tiny; says nothing about the arm
        only: one experiment; None: both
        twins: which twins; None: 0,1,2
        seeds: of training; None: 0,1,2
        loads: payloads in open space [g]; None: 35,105,220,330,500,1000
        arm: twin, or a rod, of other physics, in open space alone
        preset: of training in open space; None: analytic; in confined spaces it is quick
        env_steps: of training in open space; None: the preset's
        beside: further presets in open space with S2R, as long as they are; payload beside analytic
            as long as that
        out: working folder; None: runs/paper
    """

    smoke: bool = False
    only: Literal["open", "confined"] | None = None
    twins: cli.Integers | None = None
    seeds: cli.Integers | None = None
    loads: cli.Integers | None = None
    arm: Literal["twin", "rod"] = "twin"
    preset: Literal["quick", "analytic", "payload"] | None = None
    env_steps: int | None = None
    beside: Annotated[tuple[str, ...], names_of(BESIDE)] = ()
    out: cli.MaybePath = None

    def __call__(self) -> int:
        """Run the experiments, print and write their figures; return the exit status."""
        settings = self.settings()
        folder = self.out or Path("runs/paper-smoke" if self.smoke else "runs/paper")
        pictures = folder if self.smoke else RESULTS
        status = 0
        for experiment in [self.only] if self.only else FILMS:
            data = run(experiment, folder, pictures, settings)
            means = {"mean and deviation over runs": printed_rows(experiment, data["spreads"])}
            show(means | {"targets": data["targets"]}, experiment)
            status |= status_of(data)
            print(f"written: {pictures / json_name(experiment, settings)}")
        return 0 if self.smoke else status

    def settings(self) -> Settings:
        """Return the settings that these options choose.

        Raises:
            InputError: the options do not go together.
        """
        if self.only != "open" and self.arm == "rod":
            raise InputError(f"--only: got {self.only}, expected open with --arm rod")
        if self.beside and (self.smoke or self.only == "confined"):
            got = ",".join(self.beside)
            raise InputError(f"--beside: got {got}, expected none with --smoke or --only confined")
        training = (f"learner.total_env_steps={self.env_steps}",) if self.env_steps else None
        given = {"twins": self.twins, "seeds": self.seeds, "loads_g": self.loads}
        given |= {"preset": self.preset, "training": training}
        chosen = {name: value for name, value in given.items() if value is not None}
        return dataclasses.replace(
            SMOKE if self.smoke else Settings(), arm=self.arm, beside=self.beside, **chosen
        )


def run(experiment: str, folder: Path, pictures: Path, settings: Settings) -> dict[str, Any]:
    """Run the stages of an experiment that are not done and write its report; return the figures.

    Raises:
        JobError: a stage failed, or the folder has other settings or files of an older version.
    """
    claim(folder, settings)
    returned = run_stages(folder, settings, stages(experiment, settings))
    if no_film := returned.get("film"):
        print(f"no film: {no_film}")
    return write_report(experiment, folder, pictures, settings, load_results(folder, experiment, settings))
