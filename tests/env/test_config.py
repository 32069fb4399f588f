"""Settings of the environment that are refused."""

import math

import pytest

from mjx_softarm.env import EnvConfig, Randomisation
from mjx_softarm.mdp.rewards import RewardConfig


@pytest.mark.parametrize("word", [{"engine": "mujoco"}, {"mode": "static"}])
def test_an_unknown_engine_or_mode_is_refused_by_name(word):
    (field, value), *_ = word.items()
    with pytest.raises(ValueError, match=rf"EnvConfig\.{field}: got '{value}', expected one of"):
        EnvConfig(**word)


def test_an_arm_at_rest_observes_no_motion():
    with pytest.raises(ValueError, match="got 'motion', expected 'pose' or 'payload' for arms at rest"):
        EnvConfig(observation="motion")
    assert EnvConfig(observation="motion", mode="dynamic").moves


@pytest.mark.parametrize(
    "kind, field",
    [
        (EnvConfig, "dynamic_step_s"),
        (EnvConfig, "saturation_tolerance_mm"),
        (Randomisation, "payload_max_kg"),
        (Randomisation, "sensor_noise_mm"),
        (lambda **weight: EnvConfig(reward=RewardConfig(**weight)), "threshold"),
    ],
)
@pytest.mark.parametrize("value", [math.nan, math.inf, -1.0])
def test_a_number_that_is_negative_or_not_finite_is_refused_by_name(kind, field, value):
    with pytest.raises(ValueError, match=rf"\.{field}: got {value}, expected a finite number >"):
        kind(**{field: value})
