"""Settings of the environment that are refused."""

import dataclasses
import math
from importlib.util import find_spec

import pytest

from mjx_softarm._support.errors import InputError
from mjx_softarm._support.lazy import put
from mjx_softarm.env import EnvConfig, Randomisation, ReachEnv
from mjx_softarm.mdp.rewards import RewardConfig
from mjx_softarm.mechanics.mjcf import build_model
from mjx_softarm.spec import ArmSpec


@pytest.mark.parametrize("word", [{"engine": "mujoco"}, {"mode": "static"}])
def test_an_unknown_engine_or_mode_is_refused_by_name(word):
    (field, value), *_ = word.items()
    with pytest.raises(ValueError, match=rf"EnvConfig\.{field}: got '{value}', expected one of"):
        EnvConfig(**word)


def test_an_arm_at_rest_observes_no_motion():
    with pytest.raises(ValueError, match="got 'motion', expected 'pose' or 'payload' for arms at rest"):
        EnvConfig(observation="motion")
    assert EnvConfig(observation="motion", mode="dynamic").moves


def test_warp_moves_arms_without_dry_friction_and_needs_a_gpu(spec):
    with pytest.raises(ValueError, match="engine: got 'warp', expected one of .*'mjx', 'chain'"):
        EnvConfig(engine="warp")
    with pytest.raises(ValueError, match="friction_max_n: got 1.0, expected 0 with the engine 'warp'"):
        EnvConfig(engine="warp", mode="dynamic", randomisation=Randomisation(friction_max_n=1.0))
    with pytest.raises(InputError, match="engine 'warp': got a cpu, expected a GPU"):
        ReachEnv(spec, EnvConfig(engine="warp", mode="dynamic", n_poses=1))


@pytest.mark.skipif(find_spec("warp") is not None, reason="warp-lang is installed")
def test_warp_that_is_not_installed_is_told(spec, monkeypatch):
    monkeypatch.setattr("jax.default_backend", lambda: "gpu")
    with pytest.raises(InputError, match=r"warp-lang is not installed.*expected `pip install warp-lang`"):
        put(build_model(spec), warp=True)


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


def test_the_simulated_arm_may_have_fewer_links_than_the_specified_one():
    spec = ArmSpec.default()
    coarse = EnvConfig(links_per_section=2).arm(spec)
    assert coarse.n_links == 2 * spec.structure.n_sections < spec.n_links
    assert coarse.replace(structure=dataclasses.asdict(spec.structure)) == spec
    assert EnvConfig().arm(spec) is spec
    with pytest.raises(ValueError, match="links_per_section: got 0, expected at least 1"):
        EnvConfig(links_per_section=0)


def test_a_clearance_without_a_wall_is_refused():
    with pytest.raises(ValueError, match="clearance_cost_per_mm: got 1.0, expected 0.0 without a pipe"):
        EnvConfig(clearance_cost_per_mm=1.0)
