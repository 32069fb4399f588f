"""Gradient updates per second against SBX's TQC, both in one run on the same machine.

SBX (Stable-Baselines Jax) gets its own virtual environment, made on first use in `.venv-sbx`. Both learners
have two critics of 25 quantiles, networks of 256-256, batches of 256, and sample from a filled replay;
ours relabels besides. Rounds alternate between the two, and the ratio is that of the medians.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import venv
from pathlib import Path
from typing import Any

import numpy as np

N_ROUNDS = 5
N_UPDATES = 512
SBX_HOME = Path(__file__).resolve().parents[1] / ".venv-sbx"
SBX_PACKAGES = ("sbx-rl==0.28.0", "torch==2.13.0")

_PREPARE = """
import json, sys, time
import numpy as np
n = int(sys.argv[1])

def report(train):
    train()
    print("ready", flush=True)
    for _ in sys.stdin:
        start = time.perf_counter()
        train()
        print(json.dumps(n / (time.perf_counter() - start)), flush=True)
"""

_OURS = (
    _PREPARE
    + """
import jax, jax.numpy as jnp
from mjx_softarm.obs import ObsScale
from mjx_softarm.rewards import RewardConfig
from mjx_softarm.spec import ArmSpec
from train import replay
from train.config import PRESETS
from train.hindsight import Experience, relabel
from train.tqc import TQC, TQCConfig
config, scale, reward = PRESETS["quick"], ObsScale.from_spec(ArmSpec.default()), RewardConfig()
agent = TQC(18, 9, TQCConfig())
rng = np.random.default_rng(0)
draw = lambda *shape: jnp.asarray(rng.normal(size=(10_000, *shape)), jnp.float32)
poses, actions = (draw(6), draw(6), draw(6)), (jnp.tanh(draw(9)), jnp.tanh(draw(9)))
no_cost = jnp.zeros(10_000)
items = Experience(poses[0], poses[1], actions[0], poses[2], actions[1], draw() > 1, no_cost, draw())
memory = replay.add(
    replay.create(jax.tree.map(lambda x: x[0], items), 10_000), items, jnp.ones(10_000, bool)
)

def update(agent_state, key):
    key_sample, key_relabel, key_update = jax.random.split(key, 3)
    stored = replay.sample(memory, key_sample, 256)
    batch = relabel(stored, key_relabel, config.hindsight, scale, reward, exchange_actions=True)
    return agent.update(agent_state, batch, key_update)

updates = jax.jit(lambda state, key: jax.lax.scan(update, state, jax.random.split(key, n)))
state = agent.init(jax.random.PRNGKey(0))

def train():
    global state
    state, _ = jax.block_until_ready(updates(state, jax.random.PRNGKey(1)))

report(train)
"""
)

_SBX = (
    _PREPARE
    + """
import gymnasium as gym
from sbx import TQC

class Blank(gym.Env):
    observation_space = gym.spaces.Box(-10, 10, (18,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (9,), np.float32)
    def reset(self, seed=None, options=None):
        return np.zeros(18, np.float32), {}
    def step(self, action):
        return np.zeros(18, np.float32), 0.0, False, False, {}

model = TQC("MlpPolicy", Blank(), learning_starts=0, batch_size=256, buffer_size=10_000)
model._setup_learn(1)
rng = np.random.default_rng(0)
for _ in range(10_000):
    obs, following = rng.normal(size=(2, 1, 18)).astype(np.float32)
    action = np.tanh(rng.normal(size=(1, 9))).astype(np.float32)
    model.replay_buffer.add(obs, following, action, rng.normal(size=1), np.zeros(1), [{}])

def train():
    model.train(n, 256)  # records its losses, so it is done when it returns

report(train)
"""
)


def measure() -> dict[str, Any]:
    """Updates/s of both, and their ratio."""
    programs = {"ours": (sys.executable, _OURS), "sbx": (_sbx_python(), _SBX)}
    running = {name: _Learner(*program) for name, program in programs.items()}
    rates: dict[str, list[float]] = {name: [] for name in running}
    for _ in range(N_ROUNDS):
        for name, learner in running.items():
            rates[name].append(learner.round())
    for learner in running.values():
        learner.close()
    medians = {name: float(np.median(values)) for name, values in rates.items()}
    return {
        "updates_per_s": {name: round(value) for name, value in medians.items()},
        "ratio": round(medians["ours"] / medians["sbx"], 2),
        "rounds": {name: [round(value) for value in values] for name, values in rates.items()},
    }


class _Learner:
    """A process that trains for one round whenever it is told to."""

    def __init__(self, python: str | Path, program: str):
        environment = {**os.environ, "TF_CPP_MIN_LOG_LEVEL": "3"}
        self._process: Any = subprocess.Popen(
            [str(python), "-c", program, str(N_UPDATES)],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        while (line := self._process.stdout.readline()) != "ready\n":
            if not line:
                raise RuntimeError("a learner stopped before its first round; its own message stands above")

    def round(self) -> float:
        """Updates/s of one round."""
        self._process.stdin.write("\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())

    def close(self) -> None:
        self._process.stdin.close()
        self._process.wait()


def _sbx_python() -> Path:
    python = SBX_HOME / "bin" / "python"
    if not (SBX_HOME / "complete").exists():
        venv.create(SBX_HOME, with_pip=True, clear=True)
        subprocess.run([python, "-m", "pip", "install", "--quiet", *SBX_PACKAGES], check=True)
        (SBX_HOME / "complete").touch()
    return python
