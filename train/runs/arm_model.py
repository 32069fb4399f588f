"""Networks and workspace of an arm for its computer; the same for every policy that drives the arm."""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections import ChainMap
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

import mjx_softarm
from calib.arm import CalibratedArm
from calib.fit import payload
from mjx_softarm._support.archive import Entries, SealedFileError, entries_of, read_sealed, write_sealed
from mjx_softarm.mechanics.workspace import sample_evenly, sample_workspace
from mjx_softarm.policy.file import ArmModel, take_networks
from mjx_softarm.sensing.s2r import S2R, correct
from mjx_softarm.spec import ArmSpec
from train.runs import estimator
from train.runs.estimator import Errors, distil

N_WORKSPACE = 2048  # poses that stand for the workspace
SEED = 0  # seed of the networks and of the workspace
ESTIMATORS_FILE, _KIND = "estimators.npz", "estimators"
_NAMES = "estimator", "load_estimator", "spring_model"


class DistilledArm(NamedTuple):
    """A model of an arm, with the errors of its networks."""

    model: ArmModel
    errors: Errors


_distilled: dict[str, DistilledArm] = {}  # by key, of this process


def arm_model(
    arm: CalibratedArm, folder: Path | None = None, say: Callable[[str], object] = lambda step: None
) -> DistilledArm:
    """Return the model of an arm, which is distilled once in a process.

    Args:
        arm: the arm, calibrated or not.
        folder: keeps the model in a file, which is used again for the same arm and the same code.
        say: takes a text before each step; of none where the model is kept.

    Raises:
        SpecError: the arm settles at too few pressures.
    """
    file, key = folder and folder / ESTIMATORS_FILE, _key(arm)
    if file and (kept := _read(file, key, arm)):
        return kept
    if key not in _distilled:
        distilled = distil(arm, SEED, say)
        say("simulating the workspace")
        model = ArmModel(_workspace(arm.spec, arm.s2r), *distilled[:3], arm.s2r)
        _distilled[key] = DistilledArm(model, distilled.errors)
    if file:
        with contextlib.suppress(SealedFileError):  # a folder to read only: the next export distils anew
            _write(file, key, _distilled[key])
    return _distilled[key]


def _write(file: Path, key: str, arm: DistilledArm) -> None:
    """Keep a model in a file, with the key of its arm; the sim-to-real network has a file of its own."""
    networks = [entries_of(name, getattr(arm.model, name)) for name in _NAMES]
    others = {"key": key, "errors_json": json.dumps(arm.errors), "workspace": arm.model.workspace}
    entries = {name: np.asarray(value) for name, value in others.items()}
    write_sealed(file, dict(ChainMap(entries, *networks)), _KIND)


def _read(file: Path, key: str, arm: CalibratedArm) -> DistilledArm | None:
    """Return the model that a file keeps; None where the file is absent, damaged or of another key."""
    try:
        entries = Entries(read_sealed(file, _KIND, "python -m train export"), str(file))
        if entries.take("key", np.str_, ()) != key:
            return None
        workspace = entries.take("workspace", np.float32, (None, 6))
        model = ArmModel(workspace, *take_networks(entries, arm.spec), arm.s2r)
        return DistilledArm(model, entries.table("errors_json"))
    except SealedFileError:
        return None


def _key(arm: CalibratedArm) -> str:
    """Return a checksum of the arm with its models, of the networks' settings, JAX and the code.

    The code is `estimator.py` beside this file, `mjx_softarm/spec.py`, and the modules of `calib/fit` and of
    `_support`, `mechanics` and `sensing` in `mjx_softarm`, without subfolders. Versions of other packages,
    and the device, are not part of it.
    """
    settings = [arm.spec.to_dict(), SEED, N_WORKSPACE, estimator.N_TRAINING, estimator.N_HELD_OUT]
    digest = hashlib.sha256(
        json.dumps([*settings, estimator.SCHEDULE, estimator.PAYLOADS, jax.__version__]).encode()
    )
    for values in jax.tree.leaves((arm.s2r, arm.held)):
        digest.update(np.asarray(values).tobytes())
    package = Path(mjx_softarm.__file__).parent
    folders = (
        *(package / name for name in ("_support", "mechanics", "sensing")),
        Path(payload.__file__).parent,
    )
    modules = (file for folder in folders for file in sorted(folder.glob("*.py")))
    for source in (package / "spec.py", Path(estimator.__file__), *modules):
        digest.update(source.read_bytes())
    return digest.hexdigest()


def _workspace(spec: ArmSpec, s2r: S2R | None) -> np.ndarray:
    """Return poses (N_WORKSPACE, 6) of the real arm: half at random pressures, half uniform in volume."""
    halves = [sample(spec, N_WORKSPACE // 2, SEED) for sample in (sample_workspace, sample_evenly)]
    poses = [p.pose if s2r is None else correct(s2r, p.pose, p.spring_m) for p in halves]
    return np.concatenate(poses).astype(np.float32)
