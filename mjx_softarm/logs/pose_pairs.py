"""Pairs of poses that should be equal, as a training run or a calibration leaves them for the view.

The npz file `POSES_FILE` of a folder holds named sets: `<set>.target` and `<set>.pose` (n, 6) [mm, deg], and
`<set>.warned` (n,) bool.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mjx_softarm._support.archive import ZIP_ERRORS
from mjx_softarm._support.errors import InputError
from mjx_softarm._support.files import replacing

POSES_FILE = "poses.npz"


class PosePairs(NamedTuple):
    """n poses beside their targets."""

    target: np.ndarray  # (n, 6) [mm, deg] goals of a run, or measured tips of a calibration
    pose: np.ndarray  # (n, 6) [mm, deg] reached poses of a run, or simulated tips of a calibration
    warned: np.ndarray  # (n,) bool: saturated or not settled in a run, extrapolated in a calibration

    @property
    def error_mm(self) -> np.ndarray:
        """Distances (n,) between the positions."""
        return np.linalg.norm((self.pose - self.target)[:, :3], axis=-1)


def write_pose_pairs(folder: Path, sets: Mapping[str, PosePairs]) -> None:
    """Write named sets into a folder, whole or not at all.

    Raises:
        OSError: the file cannot be written.
    """
    arrays = {f"{name}.{field}": x for name, pairs in sets.items() for field, x in pairs._asdict().items()}
    with replacing(folder / POSES_FILE) as part, part.open("wb") as file:
        np.savez_compressed(file, **arrays)


def read_pose_pairs(folder: Path) -> dict[str, PosePairs]:
    """Read the named sets of a folder.

    Raises:
        InputError: there is no file of sets, or it cannot be read as such.
    """
    path = folder / POSES_FILE
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            names = dict.fromkeys(key.rpartition(".")[0] for key in arrays.files)
            sets = {
                name: PosePairs(*(arrays[f"{name}.{field}"] for field in PosePairs._fields)) for name in names
            }
    except FileNotFoundError as error:
        expected = f"{POSES_FILE} of a run that was evaluated, or of a calibration with a sim-to-real network"
        raise InputError(f"{folder}: got no {POSES_FILE}, expected the {expected}") from error
    except (*ZIP_ERRORS, OSError, KeyError, ValueError) as error:
        raise InputError(f"{path}: got {error}, expected sets of poses") from error
    for name, pairs in sets.items():
        n = len(pairs.warned)
        shapes = [x.shape for x in pairs]
        if shapes != [(n, 6), (n, 6), (n,)]:
            raise InputError(f"{path}: {name}: got shapes {shapes}, expected (n, 6), (n, 6) and (n,)")
    return sets
