"""Checks, before any pressure, that an arm is the one of a specification or of a policy."""

from __future__ import annotations

import time

import numpy as np

from mjx_softarm._support.errors import InputError
from mjx_softarm.deploy.arm_io import ArmIO
from mjx_softarm.deploy.controller import Controller
from mjx_softarm.sensing.estimator import expected_springs
from mjx_softarm.spec import ArmSpec

# Deviation of another arm's mean spring length, in mean section lengths; by hand. A payload of 1 kg: 0.05.
_OTHER_LENGTH = 0.25
_ANOTHER = "is it another arm, or not yet switched on"


def check_number(arm: ArmIO, spec: ArmSpec, name: str) -> np.ndarray | None:
    """Refuse an arm whose number of springs is not the specification's, before any pressure.

    Returns:
        Its readings (n_springs,). None where it could not be read: the run then says why.

    Raises:
        InputError: the number is another; the message begins with `name`.
    """
    try:
        readings = np.array(arm.read_sensors(), float)
    except Exception:  # a driver may raise anything
        return None
    if readings.shape != (spec.n_springs,):
        raise InputError(
            f"{name}: got {' x '.join(map(str, readings.shape))} readings, expected {spec.n_springs}, of "
            f"the {spec.structure.n_sections} sections of {spec.name!r}; {_ANOTHER}?"
        )
    return readings


def check_arm(arm: ArmIO, controller: Controller, name: str) -> None:
    """Refuse an arm that is not the policy's, before any pressure: by number, range and lengths of springs.

    Raises:
        InputError: it is another; the message begins with `name`.
    """
    # Readings; a run, too, waits `lost_ticks` ticks for them
    policy, spec = controller.policy, controller.policy.spec
    length_m = np.full(spec.n_springs, np.nan)
    for _ in range(controller.config.lost_ticks):
        readings = check_number(arm, spec, name)
        if readings is None:
            return
        length_m = policy.sensor.lengths(readings, np.nan).length_m
        if np.isfinite(length_m).any() or not np.isfinite(readings).all():
            break
        time.sleep(0.0 if hasattr(arm, "time_s") else controller.dt_s)
    else:
        (low, high), unit = policy.sensor.range, policy.sensor.unit
        raise InputError(
            f"{name}: got readings of {readings.min():.4g} to {readings.max():.4g} {unit}, expected "
            f"{low:.4g} to {high:.4g} {unit} as of the policy's arm {spec.name!r}; {_ANOTHER}?"
        )

    # Mean length without pressure
    if np.isfinite(length_m).any():
        got_m = np.nanmean(length_m)
        asked_m = np.mean(expected_springs(policy.spring_model, np.zeros(spec.n_chambers)))
        if abs(got_m - asked_m) > _OTHER_LENGTH * spec.length_m / spec.structure.n_sections:
            raise InputError(
                f"{name}: got springs of {1e3 * got_m:.0f} mm in the mean without pressure, expected "
                f"{1e3 * asked_m:.0f} mm as of the policy's arm {spec.name!r}; {_ANOTHER}, or still under "
                "pressure?"
            )
