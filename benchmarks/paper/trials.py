"""Trials on twins, and the stages of each experiment.

Both experiments share the folder of a benchmark:

    twinT/log.npz, twinT/calibration/      recorded and calibrated through `ArmIO` and logs alone
    twinT/demos-TASK.npz                   demonstrations of the scripted expert on the twin
    nominal-seedS/, twinT-seedS/           policies without demonstrations; the nominal ones know no twin
    KIND-twinT-seedS/                      policies without S2R, of other presets, or learned from
                                           demonstrations; see `KINDS`
    trials/TRIAL.npz                       outcome of a trial on a twin
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from benchmarks.paper import jobs
from benchmarks.paper.engine import Settings, WorkStage
from benchmarks.paper.kinds import (
    EVALUATION_FILE,
    KINDS,
    POLICY_FILE,
    TASKS,
    Trial,
    arm_name,
    learned_run,
    reach_run,
)
from benchmarks.paper.scene import CALIBRATION, demonstrations_path

FILMS = {"open": "circle.gif", "confined": "pipe.gif"}

PolicyKey = tuple[str, int, int]  # kind, twin, seed


def trainings(settings: Settings) -> list[PolicyKey]:
    """Return all policies that are learned from demonstrations."""
    learned = [kind for kind in KINDS if KINDS[kind].task]
    return [(kind, *run) for kind in learned for run in _runs(settings)]


def _runs(settings: Settings) -> list[tuple[int, int]]:
    """Return all pairs of a twin and a training seed."""
    return [(twin, seed) for twin in settings.twins for seed in settings.seeds]


def trials(experiment: str, settings: Settings) -> list[Trial]:
    """Return the trials of an experiment, a key of `FILMS`."""
    return _open_trials(settings) if experiment == "open" else _confined_trials(settings)


def _open_trials(settings: Settings) -> list[Trial]:
    loads_g, found = (0, *settings.loads_g), []
    for twin in settings.twins:
        for seed in settings.seeds:
            found += [Trial(kind, twin, seed) for kind in ("specified", "without")]
            told = ("with", *settings.beside)
            found += [Trial(kind, twin, seed, load_g=load_g) for kind in told for load_g in loads_g]
        # Without S2R one seed is enough. Gradient descent is not trained, so it runs once for each load.
        found.append(Trial("chambers", twin, settings.seeds[0]))
        found += [Trial("gradient", twin, settings.seeds[0], load_g=load_g) for load_g in loads_g]
    return found


def _confined_trials(settings: Settings) -> list[Trial]:
    found = []
    for kind, twin, seed in trainings(settings):
        if kind != "moving":
            found.append(Trial(kind, twin, seed, "as shown"))
        if kind == "pipe":
            found.append(Trial(kind, twin, seed, "exchanged"))
        # Both policies go without stops: the one trained at rest and the one trained in motion.
        if kind in ("pipe", "moving"):
            found.append(Trial(kind, twin, seed, "as shown", moves=True))
    # The policy that the circle's demonstrations begin with is tried without them.
    return found + [Trial("quick", *run) for run in _runs(settings)]


def stages(experiment: str, settings: Settings) -> list[list[WorkStage]]:
    """Return the stages of an experiment, group by group."""
    calibrations = [
        WorkStage(f"log and calibrate twin {t}", (f"twin{t}/{CALIBRATION}",), jobs.calibrate_twin, (t,))
        for t in settings.twins
    ]
    tried = [
        WorkStage(f"try {trial.name}", (trial.result,), jobs.try_out, (trial,))
        for trial in trials(experiment, settings)
    ]
    learning = _open_learning if experiment == "open" else _confined_learning
    return [calibrations, *learning(settings), [*tried, *_films(experiment, settings)]]


def _open_learning(settings: Settings) -> list[list[WorkStage]]:
    """Return the stages that train and export the policies of open space."""
    others = [("chambers", twin, settings.seeds[0]) for twin in settings.twins]
    others += [(kind, *run) for kind in settings.beside for run in _runs(settings)]
    nominal = [_reach(None, seed) for seed in settings.seeds]
    on_twins = [_reach(*run) for run in _runs(settings)]
    return [
        [*nominal, *on_twins, *(_learn(*item, jobs.train_other) for item in others)],
        [_export(twin, others, settings.seeds) for twin in (None, *settings.twins)],
    ]


def _confined_learning(settings: Settings) -> list[list[WorkStage]]:
    """Return the stages that demonstrate, train and export the policies of confined spaces."""
    demonstrations = [
        WorkStage(
            f"demonstrate {task} on twin {twin}",
            (demonstrations_path(twin, task),),
            jobs.demonstrate,
            (twin, task),
        )
        for task in TASKS
        for twin in settings.twins
    ]
    quick, learned = [("quick", *run) for run in _runs(settings)], trainings(settings)
    return [
        [*demonstrations, *(_learn(*item, jobs.train_other) for item in quick)],
        [_learn(*item) for item in learned if not KINDS[item[0]].reward_of],
        [_learn(*item) for item in learned if KINDS[item[0]].reward_of],
        [_export(twin, [*quick, *learned]) for twin in settings.twins],
    ]


def _films(experiment: str, settings: Settings) -> list[WorkStage]:
    """Return the stage that films a trial on the first twin; a rod cannot be drawn."""
    kind, objects = ("with", "") if experiment == "open" else ("pipe", "as shown")
    shown, file = Trial(kind, settings.twins[0], settings.seeds[0], objects), FILMS[experiment]
    return [WorkStage("film", (file,), jobs.film_trial, (shown, file))] * (settings.arm == "twin")


def _reach(twin: int | None, seed: int) -> WorkStage:
    name = f"train {'nominal arm' if twin is None else f'for twin {twin}'}, seed {seed}"
    return WorkStage(name, (f"{reach_run(twin, seed)}/{EVALUATION_FILE}",), jobs.train_reach, (twin, seed))


def _learn(kind: str, twin: int, seed: int, job: Callable[..., None] = jobs.learn) -> WorkStage:
    result = f"{learned_run(kind, twin, seed)}/{EVALUATION_FILE}"
    return WorkStage(f"learn {kind} for twin {twin}, seed {seed}", (result,), job, (kind, twin, seed))


def _export(twin: int | None, learned: Iterable[PolicyKey], seeds: Iterable[int] = ()) -> WorkStage:
    """Return the stage that exports an arm's policies of other kinds, and the experiment's own of `seeds`."""
    mine = [learned_run(*item) for item in learned if item[1] == twin]
    runs = (*(reach_run(twin, seed) for seed in seeds), *mine)
    policies = tuple(f"{run}/{POLICY_FILE}" for run in runs)
    return WorkStage(f"export for {arm_name(twin)}", policies, jobs.export, (twin, runs))
