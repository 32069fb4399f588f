"""The paper's experiments in confined spaces: `python -m benchmarks paper --only confined [--smoke]`.

Demonstrations are recorded on each twin, policies learned from them, and tried out on the twin: pick and
place in the pipes, the circle in the open. See `paper`, whose folder, calibrations and policies it shares.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from benchmarks.harness.parallel import Job, in_parallel
from benchmarks.paper.confined_stages import (
    KINDS,
    TASKS,
    circles,
    demonstrate,
    export,
    learn,
    load_results,
    trainings,
    trials,
    try_out,
)
from benchmarks.paper.stages import Settings, calibrations, claim, follow_circle, reach_policies


def run(folder: Path, pictures: Path, settings: Settings) -> dict[str, Any]:
    """Do what is not done yet in confined spaces and write the results; returns the figures.

    Args:
        folder: what is worked in.
        pictures: where JSON file, pictures and film go.
        settings: what to do.

    Raises:
        JobError: a job failed, or the folder is of other settings.
    """
    from benchmarks.paper.confined_report import write_results
    from mjx_softarm._support.provenance import provenance

    claim(folder, settings)
    in_parallel(calibrations(folder, settings))
    record: list[Job] = [
        (f"demonstrate {task} on twin {twin}", demonstrate, (folder, twin, task))
        for task in TASKS
        for twin in settings.twins
    ]
    in_parallel([*record, *reach_policies(folder, settings)])
    for builds_on_others in (False, True):  # those are trained first that others take the reward of
        in_parallel(
            [
                (f"learn {kind} for twin {twin}, seed {seed}", learn, (folder, settings, kind, twin, seed))
                for kind, twin, seed in trainings(settings)
                if bool(KINDS[kind].reward_of) == builds_on_others
            ]
        )
    in_parallel([(f"export for twin {twin}", export, (folder, settings, twin)) for twin in settings.twins])
    no_film = in_parallel(_trials(folder, settings))["film"]
    return write_results(
        folder, pictures, settings, load_results(folder, settings), no_film, provenance("benchmarks")
    )


def _trials(folder: Path, settings: Settings) -> list[Job]:
    from benchmarks.paper.confined_film import film_pipe

    return [
        *((f"try {trial.name}", try_out, (folder, settings, trial)) for trial in trials(settings)),
        *((f"follow {case.name}", follow_circle, (folder, settings, case)) for case in circles(settings)),
        ("film", film_pipe, (folder, settings)),
    ]
