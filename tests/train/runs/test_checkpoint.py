"""The folder of a run: refused in words, its metrics forgotten with the epochs, its policy read alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_softarm.spec import ArmSpec
from tests.train.small import LEARNER
from train.agent.analytic import AnalyticConfig
from train.agent.registry import World, learner_of
from train.config import TrainConfig
from train.epoch.job import TrainState
from train.runs.checkpoint import Run, RunError

CONFIG = TrainConfig()

pytestmark = pytest.mark.usefixtures("quick_compiler")


def test_a_folder_that_is_no_run_is_named(tmp_path):
    with pytest.raises(RunError, match="config.json: got 'No such file.*expected the folder of a run"):
        Run.open(tmp_path)
    (tmp_path / "config.json").write_text("{")
    with pytest.raises(RunError, match="config.json: got a damaged config or another version's"):
        Run.open(tmp_path)
    with pytest.raises(RunError, match="got a folder with a run, .*--resume"):
        Run.create(tmp_path, CONFIG, ArmSpec.default())


def test_metrics_later_than_the_checkpoint_are_forgotten(tmp_path):
    run = Run.create(tmp_path, CONFIG, ArmSpec.default())
    for epoch in range(1, 5):
        run.log({"epoch": epoch})
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"epoch": 5, "cut')
    run.rewind(2)
    assert run.metrics() == [{"epoch": 1}, {"epoch": 2}]


def test_the_policy_is_read_from_the_state_of_every_learner(tmp_path, short_env, imitation_config, shown):
    config, zero = imitation_config, jnp.zeros((), jnp.int32)
    configs = {
        "tqc": LEARNER,
        "analytic": AnalyticConfig(hidden=(16,), n_arms=8),
        "imitation": config.learner,
    }
    for name, own_config in configs.items():
        learner = learner_of(own_config, World(short_env, demonstrations=shown))
        run = Run.create(tmp_path / name, config, short_env.spec)
        with pytest.raises(RunError, match="got no checkpoint, expected one"):
            run.policy()
        own = jax.jit(learner.init)(jax.random.PRNGKey(0))
        run.save(1, TrainState(None, own, None, (), zero, zero), learner.parts(own))
        jax.tree.map(np.testing.assert_array_equal, run.policy(), jax.device_get(learner.policy(own)))
