"""Learner of a reach run: TQC on batches of the replay that are relabelled in hindsight."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
from jax import Array

from mjx_softarm.env import ReachEnv
from train.agent.hindsight import relabel
from train.agent.learner import Experience, Sample
from train.agent.tqc import TQC, TQCState, Transition
from train.config import TrainConfig


class HindsightTQC:
    """`Learner` whose update has two parts, between which a wrapper can change the batch."""

    own_arms = 0

    def __init__(self, config: TrainConfig, env: ReachEnv):
        self.config, self.env = config, env
        self.tqc = tqc = TQC(env.observation_size, env.action_size, config.tqc, config.n_updates)
        self.init, self.act, self.policy, self.mode = tqc.init, tqc.act, tqc.policy, tqc.mode
        self.parts = tqc.parts

    def adopt(self, state: TQCState, parts: Mapping[str, Any]) -> TQCState:
        """Return the state with another run's networks and temperature.

        A run in motion takes the policy alone, of a run at rest or in motion and of any learner. Entries of
        the observation that the other policy lacks have no weight at first, and the critics begin anew.

        Raises:
            ValueError: the other run has no such networks, or networks of another size.
        """
        if self.config.env.moves:
            return self.tqc.adopt_policy(state, parts["policy"])
        return self.tqc.adopt(state, parts)

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
            goal_ends=self.config.env.goal_ends,
            senses_action=self.config.env.observation == "motion",
        )

    def learn(self, state: TQCState, batch: Transition, key: Array) -> tuple[TQCState, dict[str, Array]]:
        """Take one gradient step on a batch; the metrics are those of `TQC.update`."""
        state, metrics = self.tqc.update(state, batch, key)
        return state, {f"tqc/{name}": x for name, x in metrics.items()}
