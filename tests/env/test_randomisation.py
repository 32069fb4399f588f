"""Differences from episode to episode: what is drawn, within which bounds, and what it does to an arm."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_softarm._support import xla
from mjx_softarm.env import EnvConfig, Randomisation, ReachEnv
from mjx_softarm.env.reach import PAYLOAD
from mjx_softarm.env.state import motion_params, nominal_share
from mjx_softarm.mechanics.params import ArmParams
from tests.arms import SHORT, with_arm

SPREAD = Randomisation(payload_max_kg=0.5, stiffness_spread=0.2)


@pytest.fixture(scope="module")
def randomised(spec, env):
    """State of as many arms as the other fixtures', every kind of randomisation on."""
    spread = ReachEnv(spec, dataclasses.replace(env.config, randomisation=SPREAD))
    keys = jax.random.split(jax.random.key(0), env.config.n_poses)
    return xla.jit(jax.vmap(spread.reset))(keys)


def assert_all_arms_have(params, drawn):
    def compare(value, own):
        np.testing.assert_array_equal(own, np.broadcast_to(value, own.shape))

    jax.tree.map(compare, params, drawn)


def test_without_randomisation_every_arm_is_the_nominal_one(spec, env, start):
    assert_all_arms_have(ArmParams.from_spec(spec), jax.vmap(env.params_of)(start.pipeline_state))


def test_randomised_numbers_fill_their_bounds_and_no_other_number_changes(spec, env, randomised):
    nominal, drawn = ArmParams.from_spec(spec), jax.vmap(env.params_of)(randomised.pipeline_state)
    payload = np.asarray(drawn.tool_mass_kg[:, PAYLOAD]) - spec.mass.payload_kg
    assert payload.min() >= 0.0 and payload.max() <= SPREAD.payload_max_kg
    factor = np.asarray(drawn.chamber_stiffness) / nominal.chamber_stiffness
    assert abs(factor - 1).max() <= SPREAD.stiffness_spread * (1 + 1e-6)
    # 512 uniform draws leave less than one of 100 equal parts empty on average.
    for value, low, high in ((payload, 0.0, 0.5), (factor, 0.8, 1.2)):
        assert np.count_nonzero(np.histogram(value, 100, (low, high))[0]) > 90
    assert np.ptp(factor, axis=1).min() > 0.02  # each chamber for itself
    changed = {"tool_mass_kg": drawn.tool_mass_kg, "chamber_stiffness": drawn.chamber_stiffness}
    assert_all_arms_have(nominal._replace(**changed), drawn)
    np.testing.assert_array_equal(drawn.tool_mass_kg[:, 0], np.float32(spec.mass.gripper_kg))


def test_payloads_go_up_to_the_arm_s_largest_where_they_are_observed(spec):
    light = spec.replace(mass={"arm_kg": 1.0, "gripper_kg": 0.175})  # a quarter of the paper's arm
    cases = ("payload", None, 0.25), ("payload", 0.1, 0.1), ("pose", None, 0)
    for observation, given_kg, expected_kg in cases:
        spread = Randomisation(payload_max_kg=given_kg)
        env = ReachEnv(light, EnvConfig(n_poses=4, observation=observation, randomisation=spread))
        assert env.payload_max_kg == pytest.approx(expected_kg)


def test_a_payload_is_observed_as_it_is_from_start_to_end(quick_compiler):
    config = EnvConfig(engine="chain", n_poses=64, observation="payload", randomisation=SPREAD)
    env = ReachEnv(SHORT, config)
    start = xla.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 64))
    actions = jax.random.uniform(jax.random.key(1), (64, env.action_size), minval=-1.0)
    after = xla.jit(jax.vmap(env.step))(start, actions)
    for state in (start, after):
        assert state.obs.shape == (64, env.observation_size)
        np.testing.assert_array_equal(state.obs[:, -1], start.pipeline_state.payload_kg)
    assert np.ptp(start.obs[:, -1]) > 0.4


def test_a_payload_and_stiffer_chambers_ask_for_other_pressures_at_the_same_spring_lengths(env, start, step):
    """By the balance of forces along a straight arm: 3 chambers carry the payload and their own stretch."""
    action = jnp.broadcast_to(env.action_of(jnp.full(9, 0.19)), (len(start.obs), 9))
    arm = start.pipeline_state
    heavy = {"payload_kg": jnp.full_like(arm.payload_kg, 0.3)}
    stiff = {"chamber_stiffness": 1.1 * arm.chamber_stiffness}
    nominal, loaded, stiffened = (
        step(with_arm(start, **changes), action).pipeline_state.pressure_kpa[0]
        for changes in ({}, heavy, stiff)
    )
    area = np.asarray(env.params.area + env.params.area_slope * (0.19 - 0.2))  # N/kPa at this length
    np.testing.assert_allclose(loaded - nominal, -0.3 * 9.81 / (3 * area), rtol=1e-3)
    stretch = 0.1 * np.asarray(arm.chamber_stiffness[0]) * (0.19 - 0.2)
    np.testing.assert_allclose(stiffened - nominal, stretch / area, rtol=1e-3)


def test_numbers_of_regulators_fill_their_bounds(spec):
    numbers = {"lag_s": 0.5, "dead_time_s": 0.2, "fill_kpa_per_s": 50.0, "vent_kpa_per_s": 20.0}
    actuators = spec.replace(actuators={"kind": "regulator", "deadband_kpa": 0.2, **numbers}).actuators
    for share, factor in ((nominal_share(actuators), 1.0), (jnp.zeros(6), 0.9), (jnp.ones(6), 1.1)):
        own = motion_params(actuators, Randomisation(regulator_spread=0.1), share)
        drawn = {name: getattr(own.actuators, name) for name in numbers} | {"dead_time_s": own.delay_s}
        for name, value in numbers.items():
            np.testing.assert_allclose(drawn[name], factor * value, rtol=1e-6)
