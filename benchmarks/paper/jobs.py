"""The stages' functions; one raises a `JobError` if a command or a recording fails.

Each runs in a process of its own, and imports its packages by itself.
"""

from __future__ import annotations

import itertools
import os
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from benchmarks.harness.parallel import JobError
from benchmarks.paper.engine import Settings, command, save_arrays
from benchmarks.paper.kinds import KINDS, POLICY_FILE, Trial, arm_name, learned_run, reach_run
from benchmarks.paper.measure import operate
from benchmarks.paper.scene import CALIBRATION, demonstrations_path, scene_of, stand_in
from mjx_softarm.mechanics.pipe import PIPES
from mjx_softarm.spec import ARM_FILE

# Without S2R a pose is off by several millimetres: a sixth of the steps teaches it.
WITHOUT_S2R = ("learner.total_env_steps=524288",)
# Presets of one learner, with and without the payload: a run beside the experiment's own gets the same
# further settings.
ALIKE = {"analytic", "payload"}
MOVING, N_MOVING = "moving.npz", 8  # log of a rod in motion, and its number of poses


def calibrate_twin(folder: Path, settings: Settings, twin: int) -> None:
    """Record a twin's logs, unless they exist, and calibrate the twin by them.

    A rod's regulators are slow; they are fitted to a second log, of all ticks between a few poses.

    Raises:
        JobError: the recording ended early.
    """
    from calib.read.logs import read_log
    from calib.run import calibrate, write_calibration
    from mjx_softarm._support import xla
    from mjx_softarm._support.provenance import provenance
    from mjx_softarm.deploy.record import record
    from mjx_softarm.logs.schema import write_log
    from mjx_softarm.mechanics.excitation import random_pressures
    from mjx_softarm.spec import ArmSpec
    from mjx_softarm.twin.instruments import S2R_SESSION

    here, spec = folder / f"twin{twin}", ArmSpec.default()
    here.mkdir(parents=True, exist_ok=True)
    n_of_logs = {"log.npz": settings.n_poses} | ({MOVING: N_MOVING} if settings.arm == "rod" else {})
    # Record random poses.
    for name, n in n_of_logs.items():
        if (here / name).exists():
            continue
        arm = stand_in(settings)(twin, spec, session=S2R_SESSION)
        recording = record(arm, spec, random_pressures(spec, n, seed=twin), transients=name == MOVING)
        if cause := recording.ending.cause:
            raise JobError(f"log of {n} poses: got a recording that ended early ({cause}), expected all")
        write_log(here / name, recording.log)
    # Calibrate from the files, as a user would.
    logs, findings = zip(*(read_log(here / name, spec) for name in n_of_logs), strict=True)
    findings = [*itertools.chain(*findings)]
    xla.enable_compilation_cache()
    calibration = calibrate(logs, spec)
    write_calibration(here / CALIBRATION, calibration, [*map(str, findings)], provenance("benchmarks"))


def train_reach(folder: Path, settings: Settings, twin: int | None, seed: int) -> None:
    """Train a policy of the nominal arm or of a twin's calibration."""
    arm = [] if twin is None else ["--calibration", folder / f"twin{twin}" / CALIBRATION]
    _reach(
        folder / reach_run(twin, seed), seed, "--preset", settings.preset, *_options(settings.training), *arm
    )


def train_other(folder: Path, settings: Settings, name: str, twin: int, seed: int) -> None:
    """Train a policy of another preset, or of a twin's calibration without its S2R network."""
    calibration, preset = folder / f"twin{twin}" / CALIBRATION, KINDS[name].reach
    if preset:
        options = ["--preset", preset, "--calibration", calibration]
        if {preset, settings.preset} == ALIKE or preset == settings.preset:
            options += _options(settings.training)
    else:
        training = settings.training or WITHOUT_S2R
        options = ["--preset", settings.preset, *_options(training), "--spec", calibration / ARM_FILE]
    _reach(folder / learned_run(name, twin, seed), seed, *options)


def _options(settings: Iterable[str]) -> list[str]:
    """Return the options of further settings of a training, NAME=VALUE."""
    return [f"--{text}" for text in settings]


def _reach(run: Path, seed: int, *options: Any) -> None:
    """Train a policy with these options, or resume an interrupted run."""
    log = run.with_suffix(".log")
    if (run / "config.json").exists():
        command(log, "reach", "--resume", str(run))
    else:
        command(log, "reach", *map(str, options), "--seed", str(seed), "--out", str(run))


def demonstrate(folder: Path, settings: Settings, twin: int, task: str) -> None:
    """Record a task's demonstrations on a twin."""
    file = folder / demonstrations_path(twin, task)
    part = file.with_name(f"part-{file.name}")  # a recording that ends early keeps its part
    part.unlink(missing_ok=True)
    arm = f"twin:{twin}:{task}" if task in PIPES else f"twin:{twin}"
    options = ["--arm", arm, "--task", task, "--calibration", str(file.parent / CALIBRATION)]
    command(file.with_suffix(".log"), "demos", "record", *options, "--out", str(part))
    os.replace(part, file)


def learn(folder: Path, settings: Settings, name: str, twin: int, seed: int) -> None:
    """Train a policy from demonstrations; resume an interrupted run."""
    run, kind = folder / learned_run(name, twin, seed), KINDS[name]
    log = run.with_suffix(".log")
    # Resume a run that has a checkpoint. Its config is written last: without one, the run starts anew,
    # since it may lack the reward or the agent that it begins with.
    saved = any(path.name.isdecimal() for path in (run / "checkpoints").glob("*"))
    if saved and (run / "config.json").exists():
        command(log, "imitate", "--resume", str(run))
        return
    shutil.rmtree(run, ignore_errors=True)
    # Start with the kind's options.
    options = ["--preset", kind.preset, "--seed", str(seed), "--out", str(run)]
    options += ["--calibration", str(folder / f"twin{twin}" / CALIBRATION)]
    if pipe := PIPES.get(kind.task):
        options += ["--pipe", f"{1e3 * pipe.diameter_m:g}"]
    for option, source in (("--reward", kind.reward_of), ("--agent", kind.begins_with)):
        if source:
            options += [option, str(folder / learned_run(source, twin, seed))]
    options += [f"--{text}" for text in (*kind.settings, *settings.imitation)]
    command(log, "imitate", str(folder / demonstrations_path(twin, kind.task)), *options)


def export(folder: Path, settings: Settings, twin: int | None, runs: tuple[str, ...]) -> None:
    """Export an arm's policies at once: they share the networks that are distilled for the arm."""
    pending = [str(folder / run) for run in runs if not (folder / run / POLICY_FILE).exists()]
    command(folder / f"export-{arm_name(twin)}.log", "export", *pending)


def try_out(folder: Path, settings: Settings, trial: Trial) -> None:
    """Run a trial and save its outcome."""
    path = folder / trial.result
    path.parent.mkdir(exist_ok=True)
    save_arrays(path, operate(*scene_of(folder, settings, trial), trial.objects, trial.moves))


def film_trial(folder: Path, settings: Settings, trial: Trial, file: str) -> str:
    """Film a trial; return why it cannot be drawn, or ""."""
    from benchmarks.paper.film import film
    from mjx_softarm.mechanics.drawing.render import RenderError

    try:
        film(folder / file, scene_of(folder, settings, trial), trial)
    except RenderError as error:
        return str(error)
    return ""
