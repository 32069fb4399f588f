"""Settings of the environment that are refused."""

import dataclasses
import math

import pytest

from mjx_softarm.env import EnvConfig, Randomisation
from mjx_softarm.mdp.rewards import RewardConfig
from mjx_softarm.spec import ArmSpec

REFUSED = [
    ({"mode": "static"}, r"EnvConfig\.mode: got 'static', expected one of"),
    ({"observation": "motion"}, "got 'motion', expected 'pose' or 'payload' for arms at rest"),
    ({"engine": "mjx-step"}, "engine: got 'mjx-step', expected one of .*'mjx', 'chain'"),
    ({"links_per_section": 0}, "links_per_section: got 0, expected a whole number >= 1"),
    ({"clearance_cost_per_mm": 1.0}, "clearance_cost_per_mm: got 1.0, expected 0.0 without a pipe"),
    ({"even_share": 1.1}, r"EnvConfig.even_share: got 1.1, expected a number >= 0 and <= 1"),
    ({"dynamic_step_s": math.nan}, r"\.dynamic_step_s: got nan, expected a number >"),
]


@pytest.mark.parametrize("settings, message", REFUSED)
def test_settings_that_cannot_be_are_refused_by_name(settings, message):
    with pytest.raises(ValueError, match=message):
        EnvConfig(**settings)


@pytest.mark.parametrize("value", [math.inf, -1.0])
def test_a_number_that_is_negative_or_not_finite_is_refused_by_name(value):
    with pytest.raises(ValueError, match=rf"\.threshold: got {value}, expected a number >"):
        EnvConfig(reward=RewardConfig(threshold=value))
    with pytest.raises(ValueError, match=rf"\.payload_max_kg: got {value}, expected a number >"):
        Randomisation(payload_max_kg=value)


def test_the_simulated_arm_may_have_fewer_links_than_the_specified_one():
    spec = ArmSpec.default()
    coarse = EnvConfig(links_per_section=2).arm(spec)
    assert coarse.n_links == 2 * spec.structure.n_sections < spec.n_links
    assert coarse.replace(structure=dataclasses.asdict(spec.structure)) == spec
    assert EnvConfig().arm(spec) is spec
