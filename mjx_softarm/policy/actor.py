"""A policy made of the actor that training leaves. NumPy only."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from mjx_softarm._support.mlp import Layer
from mjx_softarm.control import Gains
from mjx_softarm.mdp.actions import ActionMap
from mjx_softarm.mdp.observation import ObsScale
from mjx_softarm.mdp.rewards import RewardConfig
from mjx_softarm.policy.file import Policy, checked
from mjx_softarm.policy.networks import ArmModel
from mjx_softarm.spec import ArmSpec


def policy_from_actor(
    actor_params: Mapping[str, Any],
    spec: ArmSpec,
    reward: RewardConfig,
    model: ArmModel,
    provenance: Mapping[str, Any],
    **settings: Any,
) -> Policy:
    """Make the policy of an actor that was trained on an arm.

    Args:
        actor_params: as flax initialises the actor, `{"params": {"hidden_0": {"kernel", "bias"}, ...,
            "head": {"kernel", "bias"}}}`. The head's first n outputs are the mean action, the others the
            logarithms of its standard deviations.
        spec: the arm; scales, limits, calibration and gains are its own, as in the environment.
        reward: the environment's.
        model: networks and workspace of the arm.
        provenance: how the policy came about, in types that JSON has.
        settings: fields of `Policy` that have defaults, from the run, its environment and its evaluation:
            `activation`, `observation`, `tolerance_m`, `n_actions`, `action_s`.

    Raises:
        ValueError: the parameters do not belong to an actor for this arm. It is a SealedFileError if an
            array has the wrong shape or is not finite.
    """
    policy = Policy(
        layers=actor_layers(actor_params, spec),
        obs_scale=ObsScale.from_spec(spec),
        reward=reward,
        actions=ActionMap.from_spec(spec),
        gains=Gains.from_spec(spec),
        rate_hz=spec.control.rate_hz,
        **model._asdict(),
        spec=spec,
        provenance=provenance,
        **settings,
    )
    # Check the policy as if it had been read.
    return checked(policy)


def actor_layers(actor_params: Mapping[str, Any], spec: ArmSpec) -> tuple[Layer, ...]:
    """Return the actor's layers without its standard deviations; only this function knows flax's names.

    Raises:
        ValueError: the parameters, as for `policy_from_actor`, do not belong to an actor.
    """
    dense = actor_params.get("params", {})
    names = [*(f"hidden_{k}" for k in range(len(dense) - 1)), "head"]
    if set(dense) != set(names):
        raise ValueError(f"actor parameters: got {sorted(dense)}, expected hidden_0, hidden_1, ... and head")
    arrays = [[np.asarray(dense[name][part], np.float32) for part in ("kernel", "bias")] for name in names]
    arrays[-1] = [array[..., : spec.n_springs] for array in arrays[-1]]
    return tuple((weight, bias) for weight, bias in arrays)
