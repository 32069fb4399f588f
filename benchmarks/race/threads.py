"""Number of threads for PyTorch: whichever trains faster, all or one."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np

OBS_SIZE, ACTION_SIZE, N_STORED = 18, 9, 100_000


class BlankEnv(gymnasium.Env):
    """Environment of the arm's sizes that does nothing."""

    observation_space = gymnasium.spaces.Box(-10, 10, (OBS_SIZE,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (ACTION_SIZE,), np.float32)

    def reset(self, *, seed=None, options=None):
        """Return a zero observation."""
        return np.zeros(OBS_SIZE, np.float32), {}

    def step(self, action):
        """Return a zero observation without a reward."""
        return np.zeros(OBS_SIZE, np.float32), 0.0, False, False, {}


def filled_model(algorithm: Any) -> Any:
    """Return a throwaway model of a Stable-Baselines3 algorithm; its replay is full of random numbers."""
    model = algorithm("MlpPolicy", BlankEnv(), buffer_size=N_STORED)
    model._setup_learn(1)
    rng, stored = np.random.default_rng(0), model.replay_buffer
    for rows in (stored.observations, stored.next_observations, stored.rewards):
        rows[:] = rng.normal(size=rows.shape)
    stored.actions[:] = np.tanh(rng.normal(size=stored.actions.shape))
    stored.full = True
    return model


def choose_threads(train: Callable[[], Any]) -> None:
    """Let PyTorch use all its threads, or one where the fastest of three calls is faster with it."""
    import torch  # pyright: ignore[reportMissingImports]

    times = {}
    for n_threads in (torch.get_num_threads(), 1):
        torch.set_num_threads(n_threads)
        train()  # the first call with a number of threads is slow
        times[n_threads] = min(_seconds(train) for _ in range(3))
    torch.set_num_threads(min(times, key=lambda n: times[n]))


def _seconds(call: Callable[[], Any]) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start
