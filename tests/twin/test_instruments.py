"""Instruments and commands of both kinds of twins."""

from functools import partial

import numpy as np
import pytest

from mjx_softarm import ArmSpec
from mjx_softarm.twin.arm import Twin
from mjx_softarm.twin.instruments import EVALUATION_SESSION, S2R_SESSION, Build
from mjx_softarm.twin.rod_twin import RodTwin
from tests.twin.conftest import KPA, hold

KINDS = {"twin": (Twin, partial(Build, per_section=4)), "rod": (RodTwin, partial(Build, per_section=3))}
both_kinds = pytest.mark.parametrize(("make", "build"), KINDS.values(), ids=KINDS)


@both_kinds
def test_seed_chooses_the_arm_and_session_the_noise(make, build):
    def records(seed, noise=1.0, **options):
        arm = hold(make(seed, build=build(noise=noise), **options), KPA, 0.1)
        return np.concatenate([arm.read_sensors(), arm.pressures(), arm.motion_capture().tip_m])

    first = records(7)
    np.testing.assert_array_equal(first, records(7))
    assert (first != records(8)).all()
    other_day = records(7, session=S2R_SESSION)
    assert (first != other_day).all()
    np.testing.assert_allclose(first[:9], other_day[:9], atol=10 * ArmSpec.default().sensor.noise)
    silent = [records(7, noise=0.0, session=session) for session in (0, 1)]
    np.testing.assert_array_equal(*silent)
    assert S2R_SESSION != EVALUATION_SESSION


@both_kinds
def test_impossible_payloads_and_commands_are_refused_and_nothing_moves(make, build):
    for payload_kg in (-0.1, np.nan):
        with pytest.raises(ValueError, match=r"payload_kg: got .*, expected a number >= 0"):
            make(0, payload_kg=payload_kg, build=build())
    arm = make(0, build=build())
    for command, message in (
        (np.zeros(8), r"pressure_kpa: got shape \(8,\), expected \(9,\)"),
        (np.where(np.arange(9) == 2, np.nan, 0.0), r"pressure_kpa\[2\]: got nan, expected -40 to 20 kPa"),
        (np.where(np.arange(9) == 3, 20.1, 0.0), r"pressure_kpa\[3\]: got 20.1"),
        (np.full(9, -40.1), r"pressure_kpa\[0\]: got -40.1"),
    ):
        with pytest.raises(ValueError, match=message):
            arm.write_pressures(command)
    assert arm.time_s == 0.0
    arm.write_pressures(np.full(9, np.nextafter(np.float32(20.0), np.float32(21.0))))
