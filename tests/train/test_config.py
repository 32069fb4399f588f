"""Settings: overrides by name, messages that say what is wrong, and the round trip through JSON."""

import dataclasses
import json

import pytest

from train.config import ConfigError, TrainConfig, from_dict, override, to_dict
from train.presets import IMITATION_PRESETS, PRESETS


def test_overrides_reach_every_level_and_leave_the_preset_alone():
    before = PRESETS["quick"]
    after = override(before, ["seed=3", "tqc.gamma=0.25", "tqc.hidden_actor=[64, 32]", "env.engine=mjx"])
    got = (after.seed, after.tqc.gamma, after.tqc.hidden_actor, after.env.engine)
    assert got == (3, 0.25, (64, 32), "mjx")
    assert override(after, ["env.reward.threshold=1"]).env.reward.threshold == 1.0
    assert before.seed == 0 and before.env.engine == "chain"


@pytest.mark.parametrize(
    "assignment, message",
    [
        ("seed", "seed: got 'seed', expected NAME=VALUE"),
        ("sed=1", "sed: got 'sed=1', expected NAME=VALUE for one of learner, seed"),
        ("tqc.gama=1", "expected NAME=VALUE for one of hidden_actor"),
        ("seed.x=1", "seed.x: got 'seed.x=1'"),
        ("seed=one", "seed: got 'one', expected int"),
        ("seed=1.5", "seed: got 1.5, expected int"),
        ("n_arms=0", "n_arms: got 0, expected at least 1"),
        ("env.engine=fast", "env.engine: got 'fast', expected"),
        ("tqc.gamma=2", "TQCConfig.gamma"),
        ("hindsight.reached_share=0.9", "reached_share"),
        (
            "updates_per_env_step=0.001",
            "expected a finite number of at least one update per step of all",
        ),
        ("replay_capacity=10", "replay_capacity: got 10, expected at least n_arms = 128"),
    ],
)
def test_a_setting_that_cannot_be_is_named(assignment, message):
    with pytest.raises(ConfigError) as error:
        override(PRESETS["quick"], [assignment])
    assert message in str(error.value)


def test_a_payload_that_is_observed_is_up_to_the_arm_s_largest():
    for given in (0.0, 0.5):
        with pytest.raises(ConfigError, match=f"payload_max_kg: got {given:g} .*, expected none"):
            override(PRESETS["payload"], [f"env.randomisation.payload_max_kg={given}"])


def test_demonstrations_know_no_payload():
    assert override(PRESETS["quick"], ["env.observation=payload"]).env.observation == "payload"
    with pytest.raises(ConfigError, match="env.observation: got 'payload', expected 'pose' or 'motion'"):
        override(IMITATION_PRESETS["pipe"], ["env.observation=payload"])


@pytest.mark.parametrize("config", [*PRESETS.values(), *IMITATION_PRESETS.values()])
def test_presets_survive_json(config):
    assert from_dict(json.loads(json.dumps(to_dict(config)))) == config


def test_json_with_a_setting_too_many_is_refused_and_a_missing_one_has_its_default():
    data = to_dict(TrainConfig())
    with pytest.raises(ConfigError, match="config.tqc: got .* expected the settings"):
        from_dict({**data, "tqc": {**data["tqc"], "extra": 1}})
    older = {name: value for name, value in data.items() if name != "episode_length"}
    assert from_dict(older) == TrainConfig()


def test_an_epoch_count_covers_the_steps_asked_for():
    config = TrainConfig(
        total_env_steps=10_001, n_arms=100, vector_steps_per_epoch=10, updates_per_env_step=0.5
    )
    assert (config.n_epochs, config.n_updates_per_vector_step, config.n_updates) == (11, 50, 11 * 10 * 50)


def test_each_stages_end_is_evaluated(imitation_config):
    config = dataclasses.replace(imitation_config, total_env_steps=160, evaluation_epochs=4)  # 10 epochs
    assert [epoch for epoch in range(1, 11) if config.evaluates_after(epoch)] == [4, 5, 8, 10]


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ('stages=[{"part": 1.0}]', "settings"),
        ('stages=[{"share": 0.5, "every": 1, "kept": 1.0}]', "add up to 0.5, expected 1"),
        ('stages=[{"share": 1.0, "every": 0, "kept": 1.0}]', "every: got 0"),
        ("expert_share=1.0", "expert_share: got 1.0"),
        ("learned_weight=0", "expected some reward"),
        ("learned_weight=-1", "expected numbers >= 0"),
        ("rebalance_env_steps=-1", "rebalance_env_steps: got -1"),
    ],
)
def test_a_bad_setting_of_imitation_is_named(imitation_config, assignment, message):
    with pytest.raises(ConfigError, match=message):
        override(imitation_config, [assignment])
