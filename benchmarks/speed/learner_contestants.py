"""Worker of the learner benchmark: a contestant that does nothing but gradient updates, in rounds.

    python -m benchmarks.speed.learner_contestants NAME BATCH N_UPDATES

NAME is ours, sb3-contrib, sbx or brax. All have two critics and networks of 256-256, and sample each batch
from 100,000 stored transitions of the arm's sizes with random content. TQC has 25 quantiles a critic. Ours
relabels besides. The SAC of brax, whose critics give one value, runs through brax's own `train` with an
environment that does nothing.
"""

from __future__ import annotations

import queue
import sys
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from benchmarks.harness.rounds import Facts, serve

OBS_SIZE, ACTION_SIZE = 18, 9
N_STORED = 100_000


def _timed(train: Callable[[], Any], n_updates: int) -> tuple[Facts, Callable[[], Facts]]:
    """Return rounds of `train`, which blocks until it is done; the first call does not count."""
    train()
    return {}, lambda: {"updates_per_s": n_updates / _seconds(train)}


def _ours(batch_size: int, n_updates: int) -> tuple[Facts, Callable[[], Facts]]:
    """Prepare a scan of updates as in `train.epoch.job`, with the relabelling of the preset `quick`."""
    import jax
    import jax.numpy as jnp

    from mjx_softarm._support import xla
    from mjx_softarm.mdp.observation import ObsScale
    from mjx_softarm.mdp.rewards import RewardConfig
    from mjx_softarm.spec import ArmSpec
    from train.agent.hindsight import relabel
    from train.agent.learner import Experience
    from train.agent.tqc import TQC, TQCConfig
    from train.epoch import replay
    from train.presets import PRESETS

    hindsight, scale = PRESETS["quick"].hindsight, ObsScale.from_spec(ArmSpec.default())
    agent = TQC(OBS_SIZE, ACTION_SIZE, TQCConfig())
    rng = np.random.default_rng(0)

    def draw(*shape: int):
        return jnp.asarray(rng.normal(size=(N_STORED, *shape)), jnp.float32)

    stored = Experience(
        pose=draw(6),
        goal=draw(6),
        action=jnp.tanh(draw(ACTION_SIZE)),
        next_pose=draw(6),
        sensed_action=jnp.tanh(draw(ACTION_SIZE)),
        saturated=draw() > 1,
        clearance_cost=jnp.zeros(N_STORED),
        n_steps=draw(),
    )
    memory = replay.create(jax.tree.map(lambda x: x[0], stored), N_STORED)
    memory = replay.add(memory, stored, jnp.ones(N_STORED, bool))

    def update(state, key):
        key_sample, key_relabel, key_update = jax.random.split(key, 3)
        batch = replay.sample(memory, key_sample, batch_size)
        ends = {"goal_ends": True, "senses_action": False}
        batch = relabel(batch, key_relabel, hindsight, scale, RewardConfig(), **ends)
        return agent.update(state, batch, key_update)

    def scan(state, key):
        return jax.lax.scan(update, state, jax.random.split(key, n_updates))

    updates = xla.jit(scan, uses_mjx=False, donate_argnums=0)
    state = agent.init(jax.random.PRNGKey(0))

    def train() -> None:
        nonlocal state
        state, _ = jax.block_until_ready(updates(state, jax.random.PRNGKey(1)))

    return _timed(train, n_updates)


def choose_threads(train: Callable[[], Any]) -> None:
    """Let PyTorch use all its threads, or one where the fastest of three calls is faster with it."""
    import torch  # pyright: ignore[reportMissingImports]

    times = {}
    for n_threads in (torch.get_num_threads(), 1):
        torch.set_num_threads(n_threads)
        train()
        times[n_threads] = min(_seconds(train) for _ in range(3))
    torch.set_num_threads(min(times, key=lambda n: times[n]))


def _seconds(call: Callable[[], Any]) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def filled_model(algorithm: Any) -> Any:
    """Return an algorithm with a filled replay; its `train` reads its losses and so blocks."""
    import gymnasium

    class Blank(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(-10, 10, (OBS_SIZE,), np.float32)
        action_space = gymnasium.spaces.Box(-1, 1, (ACTION_SIZE,), np.float32)

        def reset(self, *, seed=None, options=None):
            return np.zeros(OBS_SIZE, np.float32), {}

        def step(self, action):
            return np.zeros(OBS_SIZE, np.float32), 0.0, False, False, {}

    model = algorithm("MlpPolicy", Blank(), buffer_size=N_STORED)
    model._setup_learn(1)
    rng, stored = np.random.default_rng(0), model.replay_buffer
    for rows in (stored.observations, stored.next_observations, stored.rewards):
        rows[:] = rng.normal(size=rows.shape)
    stored.actions[:] = np.tanh(rng.normal(size=stored.actions.shape))
    stored.full = True
    return model


def _sb3_contrib(batch_size: int, n_updates: int) -> tuple[Facts, Callable[[], Facts]]:
    from sb3_contrib import TQC  # pyright: ignore[reportMissingImports]

    model = filled_model(TQC)
    choose_threads(lambda: model.train(min(n_updates, 8), batch_size))
    return _timed(lambda: model.train(n_updates, batch_size), n_updates)


def _sbx(batch_size: int, n_updates: int) -> tuple[Facts, Callable[[], Facts]]:
    from sbx import TQC  # pyright: ignore[reportMissingImports]

    model = filled_model(TQC)
    return _timed(lambda: model.train(n_updates, batch_size), n_updates)


def _brax(batch_size: int, n_updates: int) -> tuple[Facts, Callable[[], Facts]]:
    """Prepare brax's `sac.train` in a thread: after each of its epochs it reports and waits for a round."""
    import jax.numpy as jnp
    from brax.envs.base import Env, State
    from brax.training.agents.sac import train as sac

    class Blank(Env):
        observation_size: int = OBS_SIZE
        action_size: int = ACTION_SIZE
        backend: str = ""

        def reset(self, rng):
            zero = jnp.zeros(())
            return State(zero, jnp.zeros(OBS_SIZE), zero, zero, {}, {})  # pyright: ignore[reportArgumentType]

        def step(self, state, action):
            return state

    n_envs, n_epochs = 100, 10_000  # more than will be asked for
    results: queue.Queue[Mapping[str, Any] | BaseException] = queue.Queue()
    asked = threading.Semaphore(0)

    def progress(_: int, metrics: Mapping[str, Any]) -> None:
        if "training/sps" in metrics:  # not before the first epoch
            results.put(metrics)
            asked.acquire()

    def train() -> None:
        try:
            sac.train(
                Blank(),
                num_timesteps=N_STORED + n_epochs * n_envs,
                episode_length=1,
                num_envs=n_envs,
                num_eval_envs=1,
                num_evals=n_epochs + 1,
                batch_size=batch_size,
                grad_updates_per_step=n_updates,
                min_replay_size=N_STORED,
                max_replay_size=N_STORED,
                progress_fn=progress,
            )
        except BaseException as error:  # raised where the round is waited for
            results.put(error)

    def result() -> Facts:
        found = results.get()
        if isinstance(found, BaseException):
            raise found
        return {"updates_per_s": found["training/sps"] / n_envs * n_updates}

    def work() -> Facts:
        asked.release()
        return result()

    threading.Thread(target=train, daemon=True).start()
    result()  # compiled
    return {}, work


CONTESTANTS = {"ours": _ours, "sb3-contrib": _sb3_contrib, "sbx": _sbx, "brax": _brax}

if __name__ == "__main__":
    _name, _batch_size, _n_updates = sys.argv[1:]
    serve(lambda: CONTESTANTS[_name](int(_batch_size), int(_n_updates)))
