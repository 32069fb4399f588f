"""The engine of the paper's experiments: stages whose results stay in a folder.

An experiment is a list of groups of stages. The stages of a group run in processes of their own, two at a
time; the next group begins once all of them are done. A stage whose results exist is skipped, so the same
command continues an interrupted benchmark, and twins or seeds may be added.
"""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from benchmarks.harness.common import difference
from benchmarks.harness.parallel import JobError, in_parallel
from mjx_softarm._support.files import replacing
from mjx_softarm._support.provenance import write_json

SETTINGS_FILE = "settings.json"
MORE = ("twins", "seeds", "loads_g", "beside")  # settings that results in a folder may differ in


@dataclass(frozen=True)
class Settings:
    """Size of the experiments, and how policies are trained."""

    arm: Literal["twin", "rod"] = "twin"  # stand-in for an arm; a rod in open space alone
    twins: tuple[int, ...] = (0, 1, 2)  # their seeds
    seeds: tuple[int, ...] = (0, 1, 2)
    preset: str = "analytic"  # in open space
    training: tuple[str, ...] = ()  # further settings of `train reach`, NAME=VALUE
    imitation: tuple[str, ...] = ()  # further settings of `train imitate`, NAME=VALUE
    n_poses: int = 500  # of a calibration's log
    n_points: int = 40  # of the circle
    n_positions: int | None = None  # of a pipe's task, from the first; None is all
    loads_g: tuple[int, ...] = (35, 105, 220, 330, 500, 1000)
    beside: tuple[str, ...] = ()  # further presets in open space; see `jobs.ALIKE`

    def as_json(self) -> dict[str, Any]:
        """Return all settings as JSON has them."""
        return json.loads(json.dumps(dataclasses.asdict(self)))

    def shared(self) -> dict[str, Any]:
        """Return the settings that all results in a folder share; the others may be added to later."""
        return {name: value for name, value in self.as_json().items() if name not in MORE}


_FEW = ("learner.total_env_steps=512", "learner.n_arms=16", "learner.updates_per_env_step=0.25")
SMOKE = Settings(
    twins=(0,),
    seeds=(0,),
    preset="quick",
    training=(*_FEW, "learner.warmup_env_steps=256"),
    imitation=(*_FEW, "learner.warmup_env_steps=128"),
    n_poses=80,
    n_points=4,
    n_positions=7,  # up to the first object
    loads_g=(500,),
)


class WorkStage(NamedTuple):
    """A job, called with the folder, the settings and its inputs; it is done once its results exist."""

    name: str
    results: tuple[str, ...]  # paths in the folder
    function: Callable[..., Any]
    inputs: tuple[Any, ...] = ()


def claim(folder: Path, settings: Settings) -> None:
    """Make the folder, or check that its results have these settings; one that it lacks has its default.

    Raises:
        JobError: the folder has other settings.
    """
    file, expected = folder / SETTINGS_FILE, settings.shared()
    if not file.exists():
        folder.mkdir(parents=True, exist_ok=True)
        write_json(file, expected)
    found = {**Settings().shared(), **json.loads(file.read_text("utf-8"))}
    if differing := difference(found, expected):
        raise JobError(f"{file}: {differing}; choose another --out")


def run_stages(folder: Path, settings: Any, groups: Sequence[Sequence[WorkStage]]) -> dict[str, Any]:
    """Run the stages that are not done, group by group; each function takes folder, settings and its inputs.

    Returns:
        Results of the functions that ran, by the name of the stage.

    Raises:
        JobError: a stage failed.
    """
    returned: dict[str, Any] = {}
    for group in groups:
        pending = [stage for stage in group if not all((folder / path).exists() for path in stage.results)]
        if pending:
            jobs = [(stage.name, stage.function, (folder, settings, *stage.inputs)) for stage in pending]
            returned |= in_parallel(jobs)
    return returned


def save_arrays(path: Path, arrays: Any) -> None:
    """Write a named tuple of arrays whole or not at all."""
    with replacing(path) as part, part.open("wb") as file:
        np.savez_compressed(file, **arrays._asdict())


def load_arrays(kind: Any, path: Path) -> Any:
    """Read the named tuple, of the class `kind`, that `save_arrays` wrote.

    Raises:
        JobError: it lacks an array.
    """
    with np.load(path) as file:
        if missing := [name for name in kind._fields if name not in file]:
            why = f"got no {', '.join(missing)}, expected the arrays of this version"
            raise JobError(f"{path}: {why}; remove the file, or choose another --out")
        return kind(**{name: file[name] for name in kind._fields})


def command(log: Path, *arguments: str) -> None:
    """Run `python -m train ...` and append its output to a file.

    Raises:
        JobError: it failed; the message has the last lines of its output.
    """
    with log.open("a", encoding="utf-8") as file:
        done = subprocess.run(
            [sys.executable, "-m", "train", *arguments], stdout=file, stderr=subprocess.STDOUT, check=False
        )
    if done.returncode:
        last = "\n".join(log.read_text("utf-8").splitlines()[-5:])
        raise JobError(
            f"python -m train {' '.join(arguments)}: got exit status {done.returncode}, expected 0; "
            f"{log} ends with\n{last}"
        )
