"""Contestants of the race: programs that learn to reach and are evaluated after each stretch of training.

    python -m benchmarks.race.contestants NAME SEED STRETCH_S N_GOALS

Ours is the loop of `python -m train reach` without its files. The peers have the settings of quick, but for
the temperature's learning rate, which they lack, and hindsight of their own. Once quick's env steps are over,
their learning rates begin anew.

The clock counts from the program's start. It stands while the policy is evaluated and while PyTorch's threads
are chosen. Start-up ends when a peer has done a first round of updates, and when ours has compiled.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import math
import sys
import time
import timeit
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import numpy as np

from benchmarks.harness.rounds import Facts, serve

START = time.perf_counter()

CONTESTANTS = ("ours-quick", "ours-analytic", "sbx-hindsight", "sb3-contrib-hindsight")
CHUNK = 512  # env steps in a call of `learn`
N_STORED = 100_000  # transitions for the choice of threads


class Contestant(NamedTuple):
    """A training under way."""

    train: Callable[[], None]  # trains a little further
    policy: Callable[[np.ndarray], np.ndarray]  # observations (n, 18) -> deterministic actions (n, 9)
    done: Callable[[], tuple[int, int]]  # returns env steps and updates so far
    limit: float = math.inf  # env steps after which it ends
    uncounted_s: float = 0.0  # part of the start-up that does not count


class HeldOut:
    """Evaluation at held-out goals as in `train.runs.evaluate`, for policies of any library."""

    def __init__(self, n_goals: int):
        import jax

        from mjx_softarm._support import xla
        from mjx_softarm.env import ReachEnv
        from mjx_softarm.mechanics.workspace import HELD_OUT_SEED
        from train.runs.evaluate import N_ACTIONS, paths_of, start_keys, towards

        env = ReachEnv()
        self.n_goals, self.n_actions = n_goals, N_ACTIONS
        self._paths = paths_of(env.sample_pool(n_goals, HELD_OUT_SEED).pose)  # (n_arms, k, 6)
        self._start = xla.jit(jax.vmap(env.reset))(start_keys(len(self._paths)))
        self._towards = xla.jit(jax.vmap(functools.partial(towards, env)))
        self._step = xla.jit(jax.vmap(env.step))

    def tip_error_mm(self, policy: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """Return the tip error at each goal (n_goals,), after the last action."""
        state, errors = self._start, []
        for goals in np.moveaxis(self._paths, 1, 0):
            state = self._towards(state, goals)
            for _ in range(self.n_actions):
                state = self._step(state, policy(np.array(state.obs)))
            errors.append(state.metrics["tip_error_mm"])
        return np.stack(errors, axis=1).reshape(-1)[: self.n_goals]


def ours(name: str, seed: int) -> Contestant:
    """Return one of ours, compiled."""
    import jax

    from mjx_softarm.env import ReachEnv
    from train.presets import PRESETS
    from train.runs.run import task_of

    # The preset's job; its first state is made while its epoch compiles.
    config = dataclasses.replace(PRESETS[name.removeprefix("ours-")], seed=seed)
    job = task_of(config, ReachEnv(config=config.env)).job
    state = job.start(lambda: job.init(jax.random.PRNGKey(seed)))
    act = jax.jit(job.learner.mode)

    def train() -> None:
        nonlocal state
        state, _ = jax.block_until_ready(job.epoch(state))

    def done() -> tuple[int, int]:
        epoch = int(state.n_epochs)
        return config.learner.n_env_steps(epoch), config.learner.n_updates(epoch)

    def policy(obs: np.ndarray) -> np.ndarray:
        return np.asarray(act(job.learner.policy(state.learner), obs))

    return Contestant(train, policy, done, limit=config.learner.total_env_steps)


def peer(name: str, seed: int) -> Contestant:
    """Return TQC of SBX or Stable-Baselines3-contrib with hindsight, after its first round of updates."""
    from stable_baselines3.common.logger import Logger  # pyright: ignore[reportMissingImports]

    from benchmarks.race.hindsight import GoalEnvs, HindsightBuffer, with_goals
    from mjx_softarm.env.gym import SoftArmVectorEnv, as_sb3
    from train.agent.tqc import TQCConfig
    from train.presets import PRESETS

    config, library = PRESETS["quick"], library_of(name)
    ours, n_steps = cast(TQCConfig, config.learner), 0
    algorithm = importlib.import_module(library.replace("-", "_")).TQC
    arms = SoftArmVectorEnv(ours.n_arms, ours.episode_length, config=config.env)
    # PyTorch's threads; choosing them does not count
    start = time.perf_counter()
    if library == "sb3-contrib":
        throwaway = algorithm("MlpPolicy", as_sb3(arms), buffer_size=N_STORED)
        throwaway.set_logger(Logger(None, []))
        fill(throwaway.replay_buffer)
        choose_threads(lambda: throwaway.train(gradient_steps=32, batch_size=ours.batch_size))
    uncounted_s = time.perf_counter() - start
    # The algorithm with our settings
    scale = ours.reward_scale
    model = algorithm(
        "MultiInputPolicy",
        GoalEnvs(as_sb3(arms), scale),
        seed=seed,
        replay_buffer_class=HindsightBuffer,
        replay_buffer_kwargs={
            "arm": arms.env,
            "hindsight": ours.hindsight,
            "reward_scale": scale,
            "seed": seed,
        },
        **settings_of(ours, lambda: n_steps),
    )
    model.set_logger(Logger(None, []))  # or each call of `learn` would make a folder

    def learn(n: int, **more: Any) -> None:
        nonlocal n_steps
        model.learn(n, **more)
        n_steps = model.num_timesteps

    # Train until the first updates are done
    learn(model.learning_starts + ours.n_arms)
    return Contestant(
        train=lambda: learn(CHUNK, reset_num_timesteps=False),
        policy=lambda obs: model.predict(with_goals(obs), deterministic=True)[0],
        done=lambda: (n_steps, model._n_updates),
        uncounted_s=uncounted_s,
    )


def fill(replay: Any) -> None:
    """Fill a replay buffer of Stable-Baselines3 with random numbers."""
    rng = np.random.default_rng(0)
    for rows in (replay.observations, replay.next_observations, replay.rewards):
        rows[:] = rng.normal(size=rows.shape)
    replay.actions[:] = np.tanh(rng.normal(size=replay.actions.shape))
    replay.full = True


def choose_threads(train: Callable[[], Any]) -> None:
    """Let PyTorch use all its threads, or one where the fastest of three calls is faster with it."""
    import torch  # pyright: ignore[reportMissingImports]

    times = {}
    for n_threads in (torch.get_num_threads(), 1):
        torch.set_num_threads(n_threads)
        train()  # the first call with a number of threads is slow
        times[n_threads] = min(timeit.repeat(train, number=1, repeat=3))
    torch.set_num_threads(min(times, key=lambda n: times[n]))


def settings_of(tqc: Any, n_steps: Callable[[], int]) -> dict[str, Any]:
    """Return our settings by the names that TQC of Stable-Baselines3 and SBX has; `n_steps` counts theirs."""
    low = tqc.learning_rate_end

    def learning_rate(_: float) -> float:
        share = (n_steps() % tqc.total_env_steps) / tqc.total_env_steps
        return tqc.learning_rate * (low + (1 - low) * 0.5 * (1 + math.cos(math.pi * share)))

    return {
        "learning_rate": learning_rate,
        "buffer_size": tqc.replay_capacity,
        "learning_starts": tqc.warmup_env_steps,
        "batch_size": tqc.batch_size,
        "tau": tqc.tau,
        "gamma": tqc.gamma,
        "train_freq": 1,
        "gradient_steps": tqc.n_updates_per_vector_step,
        "ent_coef": f"auto_{tqc.initial_alpha}",
        "target_entropy": tqc.target_entropy,
    }


def library_of(name: str) -> str:
    """Return the library of a peer, a key of `benchmarks.harness.peers.PINS`."""
    return name.removesuffix("-hindsight")


def prepare(name: str, seed: str, stretch_s: str, n_goals: str) -> tuple[Facts, Callable[[], Facts]]:
    """Prepare a contestant; each round is a stretch of training and an evaluation."""
    contestant = (ours if name.startswith("ours") else peer)(name, int(seed))
    start_up_s = time.perf_counter() - START - contestant.uncounted_s
    held_out = HeldOut(int(n_goals))
    held_out.tip_error_mm(contestant.policy)  # compiles
    trained_s = 0.0

    def work() -> Facts:
        nonlocal trained_s
        start = time.perf_counter()
        while True:
            contestant.train()
            n_env_steps, n_updates = contestant.done()
            ended, passed_s = n_env_steps >= contestant.limit, time.perf_counter() - start
            if ended or passed_s >= float(stretch_s):
                break
        trained_s += passed_s
        median_mm = float(np.median(held_out.tip_error_mm(contestant.policy)))
        return {
            "wall_s": start_up_s + trained_s,
            "trained_s": trained_s,
            "env_steps": n_env_steps,
            "updates": n_updates,
            "median_mm": median_mm if math.isfinite(median_mm) else None,
            "ended": ended,
        }

    return {"start_up_s": start_up_s}, work


if __name__ == "__main__":
    serve(lambda: prepare(*sys.argv[1:]))
