"""The arm as training takes it: its specification, and the models that a calibration has beside it."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple, Self

from mjx_softarm.sensing.held_pressures import (
    PRESSURES_FILE,
    HeldPressures,
    find_pressures,
    save_pressures,
)
from mjx_softarm.sensing.s2r import S2R, S2R_FILE, load_s2r, save_s2r
from mjx_softarm.spec import ARM_FILE, ArmSpec


class CalibratedArm(NamedTuple):
    """An arm with the models of its calibration; None where there is no model better than the simulation."""

    spec: ArmSpec
    s2r: S2R | None = None  # sim-to-real network
    held: HeldPressures | None = None  # residual pressures that hold the arm

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Read the arm of a calibration.

        Raises:
            InputError: a file is missing, damaged, or of another arm.
        """
        return cls.with_models(ArmSpec.from_toml(folder / ARM_FILE), folder)

    @classmethod
    def with_models(cls, spec: ArmSpec, folder: Path) -> Self:
        """Return an arm with the models that a folder has; raises as `read` does."""
        s2r, sizes = folder / S2R_FILE, (spec.structure.n_sections, spec.n_springs, spec.n_chambers)
        network = load_s2r(s2r, spec.n_springs) if s2r.exists() else None
        return cls(spec, network, find_pressures(folder, *sizes))

    def write_models(self, folder: Path) -> None:
        """Write the models into a folder, in the place of those of another arm.

        Raises:
            SealedFileError: a file cannot be written.
        """
        for name in (S2R_FILE, PRESSURES_FILE):
            (folder / name).unlink(missing_ok=True)
        if self.s2r is not None:
            save_s2r(folder / S2R_FILE, self.s2r)
        if self.held is not None:
            save_pressures(folder / PRESSURES_FILE, self.held)
