"""Settings: overrides by name, messages that say what is wrong, and the round trip through JSON."""

import dataclasses
import json
from typing import Any

import pytest

from mjx_softarm._support.errors import InputError
from train.agent.analytic import AnalyticConfig
from train.agent.tqc import TQCConfig
from train.config import TrainConfig, from_dict, override, to_dict
from train.presets import GPU_SIZES, IMITATION_PRESETS, PRESETS
from train.runs.command import ReachOptions


def test_overrides_reach_every_level_and_leave_the_preset_alone():
    before = PRESETS["quick"]
    after = override(before, ["seed=3", "learner.gamma=0.25", "learner.hidden=[64, 32]", "env.engine=chain"])
    got = (after.seed, after.learner.gamma, after.learner.hidden, after.env.engine)
    assert got == (3, 0.25, (64, 32), "chain")
    assert override(after, ["env.reward.threshold=1"]).env.reward.threshold == 1.0
    assert before.seed == 0 and before.env.engine == "mjx"


ALL_PRESETS = PRESETS | IMITATION_PRESETS


@pytest.mark.parametrize(
    "preset, assignment, message",
    [
        ("quick", "sed=1", "sed: got 'sed=1', expected NAME=VALUE for one of learner, seed"),
        ("quick", "seed=one", "seed: got 'one', expected int"),
        ("quick", "learner.n_arms=0", "learner.n_arms: got 0, expected a whole number >= 1"),
        ("quick", "learner.n_drop_per_critic=25", "learner.n_drop_per_critic: got 25, expected"),
        ("quick", "learner.updates_per_env_step=0.001", "at least one update per step of all"),
        ("quick", "learner.hindsight.near_share=2", "near_share: got 2.0, expected a number >= 0 and <="),
        ("quick", "learner.replay_capacity=10", "learner.replay_capacity: got 10, expected at least n_arms"),
        ("quick", "learner.n_ahead=4", "learner.n_ahead: got 4, expected 0 without env.observation"),
        ("payload", "env.randomisation.payload_max_kg=0.5", "payload_max_kg: got 0.5 "),
        ("pipe", "env.observation=payload", "env.observation: got 'payload', expected 'pose'"),
        ("pipe", "env.mode=dynamic", "env.mode: got 'dynamic', expected 'quasistatic'"),
        ("pipe", 'learner.stages=[{"share": 0.5}]', "expected shares that add up to 1, not 0.5"),
        ("pipe", 'learner.stages=[{"share": 1.0, "every": 0}]', "every: got 0"),
        ("pipe", "learner.gail.input_scale=0", "learner.gail.input_scale: got 0"),
    ],
)
def test_a_setting_that_cannot_be_is_named(preset, assignment, message):
    with pytest.raises(InputError) as error:
        override(ALL_PRESETS[preset], [assignment])
    assert message in str(error.value)


def test_a_run_has_the_hidden_layers_of_the_policy_that_it_begins_with():
    donor = override(PRESETS["analytic"], ["learner.hidden=[32]"])
    assert PRESETS["motion-analytic"].with_policy_of(donor).learner.hidden == (32,)


@pytest.mark.parametrize("config", [*PRESETS.values(), *IMITATION_PRESETS.values()])
def test_presets_survive_json(config):
    assert from_dict(json.loads(json.dumps(to_dict(config)))) == config


def test_json_with_a_setting_too_many_is_refused_and_a_missing_one_has_its_default():
    data = to_dict(TrainConfig())
    with pytest.raises(InputError, match="config.learner: got .* expected the settings"):
        from_dict({**data, "learner": {**data["learner"], "extra": 1}})
    with pytest.raises(InputError, match="config.learner.name: got 'ppo', expected one of tqc, analytic"):
        from_dict({**data, "learner": {"name": "ppo"}})
    assert from_dict({"learner": {"name": "tqc"}}) == TrainConfig()


def test_epochs_cover_the_steps_asked_for_and_updates_count_from_the_end_of_warm_up():
    config = TQCConfig(
        total_env_steps=10_001,
        n_arms=100,
        vector_steps_per_epoch=10,
        updates_per_env_step=0.5,
        warmup_env_steps=1_201,
    )
    assert (config.n_epochs, config.n_env_steps(11), config.n_decay_updates) == (11, 11_000, 11 * 10 * 50)
    assert [config.n_updates(epoch) for epoch in (1, 2, 3)] == [0, 7 * 50, 17 * 50]
    assert AnalyticConfig().n_updates(3) == 3 * 256
    assert config.n_env_steps(epoch := 2**33) == 1_000 * epoch


def test_each_stages_end_is_evaluated(imitation_config):
    learner = dataclasses.replace(imitation_config.learner, total_env_steps=160)  # 10 epochs
    config = dataclasses.replace(imitation_config, learner=learner, evaluation_epochs=4)
    assert [epoch for epoch in range(1, 11) if config.evaluates_after(epoch)] == [4, 5, 8, 10]


@pytest.mark.parametrize("preset", GPU_SIZES)
def test_the_sizes_for_a_gpu_fit_each_other(preset):
    learner: Any = ReachOptions.default(["--preset", preset, "--size=gpu"]).config.learner
    assert learner.n_env_steps(learner.n_epochs) == learner.total_env_steps
    if preset == "motion":
        assert learner.n_updates_per_vector_step == 128


def test_a_preset_without_a_size_for_a_gpu_says_which_have_one():
    with pytest.raises(InputError, match="got gpu with --preset quick, expected one of analytic, motion"):
        ReachOptions.default(["--preset", "quick", "--size", "gpu"])
