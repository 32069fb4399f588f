"""A trained policy as one file: made of training's actor, written, read and checked. NumPy only.

A sealed npz archive (`mjx_softarm._support.archive`) of an arm with n springs and c chambers; numbers are
float64, networks and the workspace float32.

    schema_version       () int
    spec_json            ()           the arm trained for, as `ArmSpec.to_dict` gives it
    observation          ()           kind of observation: "pose", "payload" or "motion"
    obs_layout           (O,) text    names of the observation's entries, `layouts` of that kind
    action_layout        (n,) text    names of the action's entries, `action_layout`
    actor.n_layers       () int
    actor.activation     ()           "relu" or "swish", after each layer but the last
    actor.<k>.weight     (in, out)    layer k = 0, 1, ...
    actor.<k>.bias       (out,)       the last layer's outputs (n,) are the actions before tanh
    obs_scale.<field>    (6,)         `ObsScale`: centre and scale of poses and goals
    reward.<field>       () or (6,)   `RewardConfig`: weights of the error, threshold of a goal
    action.low, .high    (n,)         readings that the actions -1 and 1 stand for, linear in between
    sensor.<field>       () or (n,)   the arm's `Sensor`: readings to lengths, and back
    gains.<field>        () or (c,)   `Gains`: the sensor-space law, without `allocation`, and pressure limits
    rate_hz              ()           rate of the sensor-space law
    n_actions            () int       actions towards each goal, as in the evaluation of the run
    action_s             ()           time between two actions in motion; 0: the policy acts on arms at rest
    tolerance_m          ()           greatest error of a spring whose chamber, at a limit, is not saturated
    workspace            (m, 6)       poses [mm, deg] that the arm reaches, spread over its workspace
    estimator.<field>                 `PoseEstimator`: spring lengths and payload to the simulated pose
    load_estimator.<field>            `LoadEstimator`: spring lengths to the pressures that hold them
    spring_model.<field>              `SpringModel`: pressures to spring lengths, to find chambers that fail
    s2r_kind             ()           "mlp", or "none": the policy was trained on simulated poses
    s2r.<field>                       `S2R`, if there is one: simulated pose to the real one
    provenance_json      ()           how the policy came about: config, versions, commit, date

The arm's numbers stand beside `spec_json` because the actor was trained with them: a later version may derive
others from the same specification. A new entry, or a new field of a class named here (`ArmSpec` included),
makes a new schema: raise `SCHEMA_VERSION`. A file of another schema is refused: its run is exported again. A
field of `ArmSpec` whose default leaves arms as they were makes none, and older files are read.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mjx_softarm._support import archive
from mjx_softarm._support.archive import Entries, entries_of
from mjx_softarm._support.mlp import ACTIVATIONS, Activation, Layer
from mjx_softarm.control import TOLERANCE_M, Gains, allocation
from mjx_softarm.mdp.actions import N_ACTIONS, ActionMap
from mjx_softarm.mdp.observation import Observation, ObsScale, layouts
from mjx_softarm.mdp.rewards import RewardConfig
from mjx_softarm.sensing.estimator import PoseEstimator, SpringModel, take_estimator, take_spring_model
from mjx_softarm.sensing.load import LoadEstimator, take_load_estimator
from mjx_softarm.sensing.s2r import S2R, take_s2r
from mjx_softarm.sensing.sensors import Sensor
from mjx_softarm.spec import ArmSpec, Mounting

SCHEMA_VERSION = 17
KIND = "policy"
LAW = Gains._fields[:-1]  # entries of the law; its allocation follows from the specification
SHIPPED = Path(__file__).parent / "shipped/paper.npz"  # for the paper's arm; its card is beside it
SHIPPED_TWIN = SHIPPED.with_name("twin0.npz")  # calibrated to twin:0


class ArmModel(NamedTuple):
    """Networks and poses of an arm that its computer needs besides the specification."""

    workspace: np.ndarray  # (m, 6) poses [mm, deg]
    estimator: PoseEstimator
    load_estimator: LoadEstimator
    spring_model: SpringModel
    s2r: S2R | None


@dataclass(frozen=True, eq=False)
class Policy:
    """A trained policy with all numbers that its actions depend on; the module lists the entries."""

    layers: tuple[Layer, ...]  # actor: observation to actions before tanh
    obs_scale: ObsScale
    reward: RewardConfig
    actions: ActionMap  # actions to readings, with the arm's sensor
    gains: Gains
    rate_hz: float
    workspace: np.ndarray  # (m, 6)
    estimator: PoseEstimator
    load_estimator: LoadEstimator
    spring_model: SpringModel
    s2r: S2R | None
    spec: ArmSpec
    provenance: Mapping[str, Any]
    activation: Activation = "relu"
    observation: Observation = "pose"
    tolerance_m: float = TOLERANCE_M
    n_actions: int = N_ACTIONS
    action_s: float = 0.0

    @property
    def obs_layout(self) -> tuple[str, ...]:
        """Names of the observation's entries."""
        return layouts(self.spec)[self.observation]

    @property
    def calibrated(self) -> bool:
        """Whether the arm shows a sign of calibration: S2R, or a mounting that is not the default.

        A mounting that somebody wrote into the arm's TOML counts as well.
        """
        return self.s2r is not None or self.spec.mounting != Mounting()

    @property
    def sensor(self) -> Sensor:
        """The arm's sensors, calibrated."""
        return self.actions.sensor


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
        settings: fields of `Policy` that have defaults.

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
    return _unpack(file_entries(policy), "policy")


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


def action_layout(spec: ArmSpec) -> tuple[str, ...]:
    """Name the action's entries: the reading of each spring, scaled from its two limits to [-1, 1]."""
    return tuple(f"{spec.sensor.reading_name}{k}" for k in range(spec.n_springs))


def save_policy(path: str | Path, policy: Policy) -> None:
    """Write a policy, whole or not at all; the same policy gives the same bytes.

    Raises:
        SealedFileError: the file cannot be written. An older file stays.
    """
    archive.write_sealed(Path(path), file_entries(policy), KIND)


def load_policy(path: str | Path) -> Policy:
    """Read a policy, and check the types, shapes and names of its entries.

    Raises:
        SealedFileError: the file is no policy of this version, is damaged, or has a wrong entry.
        SpecError: the specification of its arm is not valid.
    """
    return _unpack(archive.read_sealed(Path(path), KIND, "python -m train export"), str(path))


def file_entries(policy: Policy) -> dict[str, np.ndarray]:
    """Return the entries of a policy's file by name."""
    # Texts and numbers of the policy itself
    entries: dict[str, Any] = {
        "schema_version": SCHEMA_VERSION,
        "spec_json": json.dumps(policy.spec.to_dict()),
        "actor.activation": policy.activation,
        "observation": policy.observation,
        "obs_layout": policy.obs_layout,
        "action_layout": action_layout(policy.spec),
        "rate_hz": policy.rate_hz,
        "tolerance_m": policy.tolerance_m,
        "n_actions": policy.n_actions,
        "action_s": policy.action_s,
        "s2r_kind": "none" if policy.s2r is None else "mlp",
        "workspace": policy.workspace,
        "provenance_json": json.dumps(policy.provenance),
    }
    # The actor, and the numbers that it was trained with
    entries |= archive.layer_entries("actor", policy.layers)
    entries |= {f"action.{name}": getattr(policy.actions, name) for name in ("low", "high")}
    entries |= {f"gains.{name}": np.asarray(getattr(policy.gains, name), np.float64) for name in LAW}
    for name in ("obs_scale", "reward", "sensor"):
        numbers = entries_of(name, getattr(policy, name))
        entries |= {item: value.astype(np.float64) for item, value in numbers.items()}
    # Networks of the arm
    for name in ("estimator", "load_estimator", "spring_model", "s2r"):
        if getattr(policy, name) is not None:
            entries |= entries_of(name, getattr(policy, name))
    return {name: np.asarray(value) for name, value in entries.items()}


def _take_reward(entries: Entries) -> RewardConfig:
    names = [item.name for item in dataclasses.fields(RewardConfig) if item.name != "axes"]
    numbers = {name: entries.take(f"reward.{name}", np.float64, ()) for name in names}
    return RewardConfig(**numbers, axes=tuple(entries.take("reward.axes", np.float64, (6,)).tolist()))


def take_networks(entries: Entries, spec: ArmSpec) -> tuple[PoseEstimator, LoadEstimator, SpringModel]:
    """Take the networks `estimator`, `load_estimator` and `spring_model` of an arm from a file's entries."""
    n_sections = spec.structure.n_sections
    counts = (spec.n_chambers, spec.n_springs)
    return (
        take_estimator(entries, n_sections, spec.n_springs),
        take_load_estimator(entries, n_sections, *counts),
        take_spring_model(entries, *counts),
    )


def _unpack(arrays: Mapping[str, np.ndarray], source: str) -> Policy:
    # Refuse other schemas first, since their entries differ.
    entries = Entries(arrays, source)
    version = entries.take("schema_version", np.integer, ())
    if version != SCHEMA_VERSION:
        expected = f"expected {SCHEMA_VERSION}: export the run again, or train it anew"
        entries.fail("schema_version", f"got {version}, {expected}")
    spec = ArmSpec.from_dict(entries.table("spec_json"), f"{source}: spec_json")
    # Take every entry with its type and shape.
    n = spec.n_springs
    observation = entries.one_of("observation", tuple(layouts(spec)))
    obs_layout = layouts(spec)[observation]
    entries.names("obs_layout", obs_layout)
    entries.names("action_layout", action_layout(spec))
    s2r_kind = entries.one_of("s2r_kind", ("mlp", "none"))
    estimator, load_estimator, spring_model = take_networks(entries, spec)
    policy = Policy(
        layers=entries.layers("actor", len(obs_layout), n),
        obs_scale=entries.group("obs_scale", ObsScale, (6,)),
        reward=_take_reward(entries),
        actions=ActionMap(
            entries.group("sensor", type(spec.sensor), (), (n,)),
            *(entries.take(f"action.{name}", np.float64, (n,)) for name in ("low", "high")),
        ),
        gains=Gains(
            *(entries.take(f"gains.{name}", np.float64, (), (spec.n_chambers,)) for name in LAW),
            allocation=allocation(spec),
        ),
        rate_hz=entries.take("rate_hz", np.float64, ()),
        workspace=entries.take("workspace", np.float32, (None, 6)),
        estimator=estimator,
        load_estimator=load_estimator,
        spring_model=spring_model,
        s2r=take_s2r(entries, n) if s2r_kind == "mlp" else None,
        spec=spec,
        provenance=entries.table("provenance_json"),
        activation=entries.one_of("actor.activation", ACTIVATIONS),
        observation=observation,
        tolerance_m=entries.take("tolerance_m", np.float64, ()),
        n_actions=entries.take("n_actions", np.integer, ()),
        action_s=entries.take("action_s", np.float64, ()),
    )
    entries.finish(SCHEMA_VERSION)
    return policy
