"""Training on several devices: the numbers of one, and little that travels."""

import dataclasses
import os
import re
import subprocess
import sys

import jax
import numpy as np
import pytest

from calib.arm import CalibratedArm
from mjx_softarm._support.errors import InputError
from mjx_softarm.env import ReachEnv
from tests.arms import SHORT
from tests.train import small
from tests.train.small import new_job
from train.__main__ import main
from train.agent.registry import epoch_of
from train.epoch.devices import mesh_of, split
from train.runs.folder import Run

N_DEVICES = 8
CAPACITY = 4096  # larger than all else that has an axis
LEARNER = dataclasses.replace(
    small.LEARNER,
    n_arms=16,
    total_env_steps=256,
    warmup_env_steps=32,
    batch_size=32,
    replay_capacity=CAPACITY,
    learning_rate_end=1.0,
)
CONFIG = dataclasses.replace(small.CONFIG, learner=LEARNER)

pytestmark = [
    pytest.mark.usefixtures("quick_compiler"),
    pytest.mark.skipif(
        len(jax.local_devices()) < N_DEVICES, reason=f"needs {N_DEVICES} devices, which a CPU can simulate"
    ),
]


@pytest.fixture(scope="module")
def env():
    return ReachEnv(SHORT, CONFIG.env)


@pytest.fixture(scope="module")
def jobs(env):
    return {n: new_job(CONFIG, env, mesh=mesh_of(n)) for n in (1, N_DEVICES)}


@pytest.fixture(scope="module")
def trained(jobs):
    """By number of devices: state and metrics after four epochs, of which three learn."""
    results = {}
    for n, job in jobs.items():
        state = job.init(jax.random.PRNGKey(0))
        for _ in range(4):
            state, metrics = job.epoch(state)
        results[n] = state, jax.device_get(metrics)
    return results


def test_many_devices_compute_what_one_does(trained):
    (one, metrics_of_one), (many, metrics) = trained.values()
    assert LEARNER.n_updates(int(many.n_epochs)) == 4 * 16 * 2 / 2 - 16  # so the networks have moved
    for name, value in metrics.items():
        np.testing.assert_allclose(value, metrics_of_one[name], rtol=1e-4, atol=1e-4, err_msg=name)
    close = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-3)  # noqa: E731  # poses in mm
    jax.tree.map(close, jax.device_get(many.memory), jax.device_get(one.memory))
    close = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6)  # noqa: E731
    jax.tree.map(close, jax.device_get(many.learner.actor_params), jax.device_get(one.learner.actor_params))


def test_each_device_has_its_share_of_arms_and_replay_and_all_of_the_networks(trained):
    state, _ = trained[N_DEVICES]
    for leaf in jax.tree.leaves((state.arms, state.memory.data)):
        shapes = {shard.data.shape for shard in leaf.addressable_shards}
        assert shapes == {(leaf.shape[0] // N_DEVICES, *leaf.shape[1:])}
        assert len({shard.device for shard in leaf.addressable_shards}) == N_DEVICES
    assert all(leaf.is_fully_replicated for leaf in jax.tree.leaves(state.learner))


_MOVES = re.compile(r"= .* (all-gather|all-reduce|all-to-all|collective-permute|reduce-scatter)")


def test_arms_step_and_start_anew_without_waiting_for_other_devices(env, trained):
    arms = epoch_of(LEARNER, env, mesh_of(N_DEVICES)).arms
    state, _ = trained[N_DEVICES]
    action = jax.device_put(jax.numpy.zeros((arms.n, arms.env.action_size)), split(arms.mesh))
    program = jax.jit(arms.step).lower(state.arms, action, jax.random.PRNGKey(0)).compile().as_text()
    assert f"f32[{arms.n // N_DEVICES},{arms.env.action_size}]" in program  # each has its share
    assert not [line for line in program.splitlines() if _MOVES.search(line)]


def test_the_epoch_is_traced_once_and_the_replay_stays_where_it_is(jobs, trained):
    job = jobs[N_DEVICES]
    assert job.n_traces == 1
    program = job._epoch.lower(trained[N_DEVICES][0], job.env.pool).compile().as_text()
    moves = [line for line in program.splitlines() if _MOVES.search(line)]
    shapes = [shape for line in moves for shape in re.findall(r"\w\[([\d,]+)\]", line)]
    assert moves and any("all-reduce" in line for line in moves)  # of gradients
    assert not any("collective-permute" in line for line in moves)  # of random numbers
    assert max(int(n) for shape in shapes for n in shape.split(",")) < CAPACITY


def test_a_checkpoint_of_many_devices_continues_on_one(tmp_path, jobs, trained):
    state, _ = trained[N_DEVICES]
    run = Run.create(tmp_path / "run", CONFIG, CalibratedArm(SHORT))
    run.checkpoints.save(4, state, jobs[N_DEVICES].parts(state))
    expected = jax.device_get(state.learner.actor_params)
    for n, job in jobs.items():
        epoch, restored = run.checkpoints.restore(job.init(jax.random.PRNGKey(1)))
        assert epoch == 4
        jax.tree.map(np.testing.assert_array_equal, jax.device_get(restored.learner.actor_params), expected)
        following, _ = job.epoch(restored)
        assert int(following.n_epochs) == 5, n
        assert job.n_traces == 1  # so it came back as the epoch expects it


_RESTORE = """
import sys, jax, numpy as np
from pathlib import Path
from train.runs.folder import Run
run = Run.open(Path(sys.argv[1]))
assert len(jax.devices()) == 1
print(sum(float(np.abs(x).sum()) for x in jax.tree.leaves(run.policy())))
"""


def test_a_policy_of_many_devices_is_read_where_there_is_one(tmp_path, jobs, trained):
    state, _ = trained[N_DEVICES]
    parts = jobs[N_DEVICES].parts(state)
    Run.create(tmp_path / "run", CONFIG, CalibratedArm(SHORT)).checkpoints.save(4, state, parts)
    done = subprocess.run(
        [sys.executable, "-c", _RESTORE, str(tmp_path / "run")],
        env={**os.environ, "JAX_NUM_CPU_DEVICES": "1", "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    leaves = jax.tree.leaves(jax.device_get(parts["policy"]))
    np.testing.assert_allclose(float(done.stdout), sum(np.abs(x).sum() for x in leaves), rtol=1e-5)


@pytest.mark.parametrize("name", ["n_arms", "replay_capacity", "batch_size"])
def test_what_cannot_be_split_evenly_is_named(env, name):
    learner = dataclasses.replace(LEARNER, **{name: getattr(LEARNER, name) + 4})
    config = dataclasses.replace(CONFIG, learner=learner)
    with pytest.raises(InputError, match=rf"^learner\.{name}: got .* expected a multiple of the {N_DEVICES}"):
        new_job(config, env, mesh=mesh_of(N_DEVICES))


@pytest.mark.parametrize("devices", ["0", "-1", "1000000"])
def test_devices_that_are_not_there_are_refused(devices, capsys):
    assert main(["reach", f"--devices={devices}"]) == 2
    assert "--devices: got" in capsys.readouterr().err
