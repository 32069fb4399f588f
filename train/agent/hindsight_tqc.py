"""TQC on batches of the replay that are relabelled in hindsight."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
from jax import Array

from mjx_softarm.env import ReachEnv
from train.agent.hindsight import relabel
from train.agent.learner import Experience, Explored, Learner, Sample, Transition
from train.agent.tqc import TQC, TQCConfig, TQCState


class HindsightTQC(Learner):
    """`Learner` whose update has two parts, between which a wrapper can change the batch."""

    def __init__(self, config: TQCConfig, env: ReachEnv):
        self.config, self.env = config, env
        self.tqc = tqc = TQC(env.observation_size, env.action_size, config)
        self.init, self.policy, self.mode, self.parts = tqc.init, tqc.policy, tqc.mode, tqc.parts

    def act(self, state: TQCState, obs: Array, key: Array) -> Explored:
        """Sample actions (..., A) in (-1, 1) at obs (..., O)."""
        return Explored(self.tqc.act(state, obs, key))

    def adopt(self, state: TQCState, parts: Mapping[str, Any]) -> TQCState:
        """Return the state with another run's networks and temperature.

        A run in motion takes the policy alone, of a run at rest or in motion and of any learner. Entries of
        the observation that the other policy lacks have no weight at first, and the critics begin anew.

        Raises:
            ValueError: the other run has no such networks, or networks of another size.
        """
        if self.env.config.moves:
            return self.tqc.adopt_policy(state, parts["policy"])
        return self.tqc.adopt(state, parts)

    def update(self, state: TQCState, sample: Sample, key: Array) -> tuple[TQCState, dict[str, Array]]:
        """Take one gradient step of all networks on one relabelled batch."""
        key_sample, key_relabel, key_update = jax.random.split(key, 3)
        batch, _ = self.transitions(sample(key_sample, self.config.hindsight.n_later), key_relabel)
        return self.learn(state, batch, key_update)

    def transitions(self, stored: Experience, key: Array) -> tuple[Transition, Array]:
        """Relabel a batch of B stored transitions; also return which of them (B,) have another goal."""
        return relabel(
            stored,
            key,
            self.config.hindsight,
            self.env.scale,
            self.env.config.reward,
            goal_ends=self.env.config.goal_ends,
            senses_action=self.env.config.observation == "motion",
        )

    def learn(self, state: TQCState, batch: Transition, key: Array) -> tuple[TQCState, dict[str, Array]]:
        """Take one gradient step on a batch; the metrics are those of `TQC.update`."""
        state, metrics = self.tqc.update(state, batch, key)
        return state, {f"tqc/{name}": x for name, x in metrics.items()}
