"""The rod twin behind `ArmIO`."""

import ast
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mjx_softarm._support.errors import InputError
from mjx_softarm.deploy.drivers.names import open_arm
from mjx_softarm.spec import ArmSpec
from mjx_softarm.twin import rod, rod_twin
from mjx_softarm.twin.instruments import Build
from mjx_softarm.twin.rod_twin import RodTwin, draw_regulator
from tests.twin.conftest import KPA, hold

EXACT = Build(losses=0.0, noise=0.0, per_section=3)  # without deadband and noise


@pytest.mark.parametrize("module", [rod, rod_twin])
def test_it_is_written_without_the_training_model(module):
    tree = ast.parse(Path(module.__file__).read_text("utf-8"))
    imported = " ".join(ast.unparse(n) for n in ast.walk(tree) if isinstance(n, ast.Import | ast.ImportFrom))
    assert imported and "mechanics" not in imported and "mujoco" not in imported


def test_refinement_changes_little():
    """Half as many elements again, a heavy payload, every part off."""
    tips = []
    for per_section in (6, 9):
        arm = RodTwin(101, payload_kg=1.0, build=Build(noise=0.0, per_section=per_section))
        arm.settle(KPA)
        tips.append(arm.motion_capture().tip_m)
    assert np.linalg.norm(tips[0] - tips[1]) < 2.5e-4


def test_mount_and_tilt_show_with_the_arm_hanging():
    straight = RodTwin(101, build=Build(gap=0.0, noise=0.0, per_section=3)).motion_capture()
    np.testing.assert_allclose(straight.tip_quaternion, [1.0, 0.0, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(straight.tip_m[:2], 0.0, atol=1e-9)
    off = RodTwin(101, build=Build(noise=0.0, per_section=3)).motion_capture()
    turn = Rotation.from_quat(off.tip_quaternion, scalar_first=True)
    assert 1.0 < np.degrees(turn.magnitude()) < 20.0
    assert off.marker_m.shape == (9, 3)


def test_pressures_and_tip_follow_with_a_lag():
    arm, regulator = RodTwin(101, build=EXACT), draw_regulator(101, ArmSpec.default(), 0.0)
    arm.write_pressures(KPA)
    np.testing.assert_array_equal(arm.pressures(), 0.0)  # dead times are longer than a control period
    hold(arm, KPA, 0.98)
    rate = np.where(KPA > 0.0, regulator.fill_kpa_per_s, regulator.vent_kpa_per_s)
    active_s = 1.0 - regulator.dead_time_s
    most = np.minimum(rate * active_s, np.abs(KPA) * -np.expm1(-active_s / regulator.lag_s))
    assert (np.abs(arm.pressures()) < 1.2 * most + 1.0).all() and (np.abs(arm.pressures()) > 0.3 * most).all()
    early = arm.motion_capture().tip_m
    late, later = (hold(arm, KPA, 12.0).motion_capture().tip_m for _ in range(2))
    assert np.linalg.norm(early - late) > 0.01 > 1e-5 > np.linalg.norm(later - late)
    np.testing.assert_allclose(arm.pressures(), KPA, atol=1e-3)
    assert arm.time_s == pytest.approx(25.0)


def test_it_has_a_name():
    assert isinstance(open_arm("twin:rod:3"), RodTwin)
    with pytest.raises(InputError, match="twin:rod:SEED: got '.*', expected an integer >= 0"):
        open_arm("twin:rod:3:pipe300")
