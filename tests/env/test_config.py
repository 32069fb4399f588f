"""Settings of the environment that are refused."""

import dataclasses
import math

import pytest

from mjx_softarm.env import EnvConfig, Randomisation
from mjx_softarm.mdp.rewards import RewardConfig
from mjx_softarm.spec import ArmSpec

REFUSED = [
    ({"reward": RewardConfig(threshold=math.inf)}, r"\.threshold: got inf, expected a number >"),
    ({"reward": RewardConfig(axes=(0.0,) * 6)}, r"axes: got .*, expected six finite numbers"),
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


def test_a_negative_payload_is_refused_and_an_arm_that_stands_in_a_pipe():
    with pytest.raises(ValueError, match=r"\.payload_max_kg: got -1.0, expected a number >"):
        Randomisation(payload_max_kg=-1.0)
    standing = ArmSpec.default().replace(mounting={"base_turn_deg": (180.0, 0.0, 0.0)})
    with pytest.raises(ValueError, match="pipe_diameter_mm: got 300.0, expected None, as .* does not hang"):
        EnvConfig(pipe_diameter_mm=300.0).arm(standing)


def test_the_simulated_arm_may_have_fewer_links_than_the_specified_one():
    spec = ArmSpec.default()
    coarse = EnvConfig(links_per_section=2).arm(spec)
    assert coarse.n_links == 2 * spec.structure.n_sections < spec.n_links
    assert coarse.replace(structure=dataclasses.asdict(spec.structure)) == spec
    assert EnvConfig().arm(spec) is spec
