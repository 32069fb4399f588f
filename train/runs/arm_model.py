"""Networks and workspace of an arm for its computer; the same for every policy that drives the arm."""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections import ChainMap
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

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
from train.runs.estimator import Distilled, distil

N_WORKSPACE = 2048  # poses that stand for the workspace
SEED = 0  # seed of the networks and of the workspace
ESTIMATORS_FILE, _KIND = "estimators.npz", "estimators"
_NAMES = "estimator", "load_estimator", "spring_model"
_distilled: dict[str, Distilled] = {}  # by key, of this process


class DistilledArm(NamedTuple):
    """A model of an arm, with the errors of its networks."""

    model: ArmModel
    errors: dict[str, Any]  # by name and payload, in types that JSON has


def arm_model(
    arm: CalibratedArm, folder: Path | None = None, tell: Callable[[str], object] = lambda text: None
) -> DistilledArm:
    """Return the model of an arm, which is distilled once in a process.

    Args:
        arm: the arm, calibrated or not.
        folder: keeps the networks in a file, which is used again for the same arm and the same code.
        tell: takes a line before the networks are distilled, unless this process has them already.

    Raises:
        SpecError: the arm settles at too few pressures.
    """
    file, key = folder and folder / ESTIMATORS_FILE, _key(arm)
    # Take the networks of the folder or of this process, else distil them
    if file and (kept := _read(file, key, arm.spec)):
        networks, errors = kept
    else:
        if key not in _distilled:
            tell("distilling pose and payload estimators for this arm, about a minute ...")
            _distilled[key] = distil(arm, SEED)
        distilled = _distilled[key]
        networks = distilled.estimator, distilled.load_estimator, distilled.spring_model
        errors = {
            name: {f"{kg:g} kg": error._asdict() for kg, error in by_payload.items()}
            for name, by_payload in distilled.errors.items()
        }
        # Keep them in the folder
        if file:
            entries = [entries_of(name, network) for name, network in zip(_NAMES, networks, strict=True)]
            told = {"key": np.asarray(key), "errors_json": np.asarray(json.dumps(errors))}
            with contextlib.suppress(SealedFileError):  # a folder to read only: the next export distils anew
                write_sealed(file, dict(ChainMap(told, *entries)), _KIND)
    return DistilledArm(ArmModel(_workspace(arm.spec, arm.s2r), *networks, arm.s2r), errors)


def _read(file: Path, key: str, spec: ArmSpec) -> tuple[tuple[Any, Any, Any], dict[str, Any]] | None:
    """Return the networks of a file with their errors; None where it is absent, damaged or of another key."""
    try:
        entries = Entries(read_sealed(file, _KIND, "python -m train export"), str(file))
        if entries.take("key", np.str_, ()) != key:
            return None
        return take_networks(entries, spec), entries.table("errors_json")
    except SealedFileError:
        return None


def _key(arm: CalibratedArm) -> str:
    """Return a checksum of the arm with its models, of the networks' settings, JAX and the code.

    The code is `estimator.py` and `first_networks.py` beside this file, `payload.py`, `held_pressures.py` and
    `s2r.py` of `calib/fit`, `mjx_softarm/spec.py` and the modules of `_support`, `mechanics` and `sensing`,
    without subfolders. Versions of other packages, and the device, are not part of it.
    """
    settings = [arm.spec.to_dict(), SEED, estimator.N_TRAINING, estimator.N_HELD_OUT, estimator.SCHEDULE]
    digest = hashlib.sha256(json.dumps([*settings, estimator.PAYLOADS, jax.__version__]).encode())
    for values in jax.tree.leaves((arm.s2r, arm.held)):
        digest.update(np.asarray(values).tobytes())
    package = Path(mjx_softarm.__file__).parent
    folders = (package / name for name in ("_support", "mechanics", "sensing"))
    for source in (
        package / "spec.py",
        *(Path(payload.__file__).with_name(name) for name in ("payload.py", "held_pressures.py", "s2r.py")),
        *(Path(__file__).with_name(name) for name in ("estimator.py", "first_networks.py")),
        *(f for d in folders for f in d.glob("*.py")),
    ):
        digest.update(source.read_bytes())
    return digest.hexdigest()


def _workspace(spec: ArmSpec, s2r: S2R | None) -> np.ndarray:
    """Return poses (N_WORKSPACE, 6) of the real arm: half at random pressures, half uniform in volume."""
    halves = [sample(spec, N_WORKSPACE // 2, SEED) for sample in (sample_workspace, sample_evenly)]
    poses = [p.pose if s2r is None else correct(s2r, p.pose, p.spring_m) for p in halves]
    return np.concatenate(poses).astype(np.float32)
