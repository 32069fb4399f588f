"""The distilled networks of an arm, kept in the folder of a run."""

import jax
import numpy as np
import pytest

from calib.arm import CalibratedArm
from mjx_softarm.policy.file import SHIPPED, load_policy
from train.runs import arm_model
from train.runs.arm_model import ArmModel, DistilledArm

POLICY = load_policy(SHIPPED)


ERRORS = {"tip_mm": {"0 kg": {"median": 1.0, "p95": 2.0, "largest": 3.0}}}


@pytest.fixture(autouse=True)
def distilled_at_once(monkeypatch):
    model = ArmModel(*(getattr(POLICY, name) for name in ArmModel._fields))

    def distil(arm, say):
        say("distilled")
        return DistilledArm(model, ERRORS)

    monkeypatch.setattr(arm_model, "distil", distil)
    monkeypatch.setattr(arm_model, "_distilled", {})


def test_networks_are_distilled_again_only_for_another_arm_or_code(tmp_path, monkeypatch):
    printed, file = [], tmp_path / arm_model.ESTIMATORS_FILE

    def model(spec=POLICY.spec):
        """Return the model as another process makes it."""
        monkeypatch.setattr(arm_model, "_distilled", {})
        return arm_model.arm_model(CalibratedArm(spec), tmp_path, printed.append)

    first, again = model(), model()
    jax.tree.map(np.testing.assert_array_equal, first.model, again.model)
    assert first.errors == again.errors and len(printed) == 1

    other = POLICY.spec.replace(mass={"payload_kg": 0.1})
    model(other), model(other)
    assert len(printed) == 2
    file.write_bytes(file.read_bytes()[:-100])
    model(other)
    assert len(printed) == 3
    monkeypatch.setattr(arm_model, "N_TRAINING", 1)
    model(other)
    assert len(printed) == 4


def test_a_folder_to_read_only_changes_nothing(tmp_path):
    printed = []
    for _ in range(2):  # the second time, the process has the networks
        arm_model.arm_model(CalibratedArm(POLICY.spec), tmp_path / "absent", printed.append)
    assert len(printed) == 1
