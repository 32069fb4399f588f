"""The learner of a reach run: TQC on batches of the replay that are relabelled in hindsight."""

from __future__ import annotations

from typing import Any, Protocol

import jax
from jax import Array

from mjx_softarm.env import ReachEnv
from train.agent.hindsight import relabel
from train.agent.learner import Experience, Learner, Sample
from train.agent.tqc import TQC, TQCState, Transition
from train.config import TrainConfig


class OffPolicyLearner(Learner, Protocol):
    """A learner whose update has two parts, between which a wrapper can change the batch."""

    def transitions(self, stored: Experience, key: Array) -> Transition:
        """Return the batch to learn from, made of B stored transitions."""
        ...

    def learn(self, state: Any, batch: Transition, key: Array) -> tuple[Any, dict[str, Array]]:
        """Take one gradient step on a batch; return the next state and scalar metrics by name."""
        ...

    def adopt(self, state: Any, donor: Any) -> Any:
        """Return the state with the networks of a donor, which is a state of the same kind.

        Raises:
            ValueError: the donor's networks are of another size.
        """
        ...


class HindsightTQC:
    """`OffPolicyLearner` by truncated quantile critics and `relabel`."""

    def __init__(self, config: TrainConfig, env: ReachEnv):
        self.config, self.env = config, env
        self.tqc = TQC(env.observation_size, env.action_size, config.tqc, config.n_updates)

    def init(self, key: Array) -> TQCState:
        """Return fresh networks."""
        return self.tqc.init(key)

    def act(self, state: TQCState, obs: Array, key: Array) -> Array:
        """Sample actions (..., A) in (-1, 1) at obs (..., O)."""
        return self.tqc.act(state.actor_params, obs, key)

    def policy(self, state: TQCState) -> Any:
        """Return the parameters of the mean actor."""
        return state.mean_actor_params

    def mode(self, policy: Any, obs: Array) -> Array:
        """Return the deterministic actions (..., A) in (-1, 1) at obs (..., O)."""
        return self.tqc.mode(policy, obs)

    def update(self, state: TQCState, sample: Sample, key: Array) -> tuple[TQCState, dict[str, Array]]:
        """Take one gradient step of all networks on one relabelled batch."""
        key_sample, key_relabel, key_update = jax.random.split(key, 3)
        return self.learn(state, self.transitions(sample(key_sample), key_relabel), key_update)

    def transitions(self, stored: Experience, key: Array) -> Transition:
        """Relabel a batch of B stored transitions."""
        return relabel(
            stored,
            key,
            self.config.hindsight,
            self.env.scale,
            self.config.env.reward,
            exchange_actions=self.config.env.mode == "quasistatic",
        )

    def learn(self, state: TQCState, batch: Transition, key: Array) -> tuple[TQCState, dict[str, Array]]:
        """Take one gradient step on a batch; the metrics are those of `TQC.update`."""
        state, metrics = self.tqc.update(state, batch, key)
        return state, {f"tqc/{name}": x for name, x in metrics.items()}

    def adopt(self, state: TQCState, donor: TQCState) -> TQCState:
        """Return the state with a donor's networks and temperature; see `TQC.adopt`."""
        return self.tqc.adopt(state, donor)
