"""Options of the arm, which several commands have, and what each of them begins with."""

from __future__ import annotations

from dataclasses import dataclass

from rich.console import Console

from calib.arm import CalibratedArm
from mjx_softarm._support import cli, xla
from mjx_softarm._support.errors import InputError
from mjx_softarm.sensing.s2r import S2R_FILE
from mjx_softarm.spec import ArmSpec


@dataclass(frozen=True, kw_only=True)
class ArmOptions:
    """The arm: specified, calibrated, or the paper's."""

    spec: cli.SpecFile = None
    calibration: cli.MaybePath = None
    """folder that `python -m calib run` made, in the place of --spec"""

    def read_arm(self, console: Console) -> CalibratedArm:
        """Return the arm, with the models of its calibration if it has one."""
        if self.calibration is None:
            return CalibratedArm(ArmSpec.of(self.spec))
        if self.spec:
            raise InputError(f"--spec {self.spec}: got --calibration {self.calibration} too, expected one")
        arm = CalibratedArm.read(self.calibration)
        if arm.s2r is None:
            absent = self.calibration / S2R_FILE
            console.print(f"no {absent}: training on simulated poses")
        return arm


def start() -> Console:
    """Turn on the cache of compiled programs; return the console to print to, which breaks no line."""
    xla.enable_compilation_cache()
    return Console(highlight=False, markup=False, soft_wrap=True)
