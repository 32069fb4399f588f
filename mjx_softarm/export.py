"""A trained policy as one file: what is in it, and how it is written and read. NumPy only.

The file is an npz archive, sealed: it ends in a mark and the SHA-256 of every byte before, so that a file
that is incomplete or changed is never taken for a policy. n is the number of chambers; numbers are float64,
the actor's weights float32.

    schema_version       () int
    spec_json            ()           the arm trained for, as `ArmSpec.to_dict` gives it
    obs_layout           (18,) text   names of the observation's entries, `OBS_LAYOUT`
    action_layout        (n,) text    names of the action's entries, `action_layout`
    actor.n_layers       () int
    actor.<k>.weight     (in, out)    layer k = 0, 1, ...; ReLU after each but the last,
    actor.<k>.bias       (out,)       whose outputs (n,) are the actions before tanh
    obs_scale.<field>    (6,)         `ObsScale`: centre and scale of poses and goals
    reward.<field>       ()           `RewardConfig`: weights of the error, threshold of a goal
    frequency_hz         (n, 2)       what the actions -1 and 1 stand for, linear in between
    sensor.<field>       () or (n,)   `SensorParams`: frequencies to lengths, and back
    gains.<field>        () or (n,)   `Gains`: the sensor-space law and the pressure limits
    rate_hz              ()           of the sensor-space law
    s2r_kind             ()           "none"; slot of a network that corrects the estimated pose
    provenance_json      ()           how the policy came about: config, versions, commit, date

The arm's numbers stand next to `spec_json` because the actor was trained with these, whatever a later version
derives from a specification. To add an entry, or a field to a class named here (`ArmSpec` included), is to
make a new schema: raise `SCHEMA_VERSION`, and let `load_policy` read the old one too.
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from mjx_softarm.control import Gains
from mjx_softarm.obs import OBS_LAYOUT, OBS_SIZE, ObsScale
from mjx_softarm.rewards import RewardConfig
from mjx_softarm.sensors import SensorFault, SensorParams, frequency_range_hz, length_from_frequency
from mjx_softarm.spec import ArmSpec, SpecError

SCHEMA_VERSION = 1

_MARK = b"mjx_softarm policy, sha256 "
_N_DIGEST = 64  # hexadecimal digits, the last bytes of the file


Layer = tuple[np.ndarray, np.ndarray]  # weight (in, out), bias (out,), float32


class PolicyFileError(ValueError):
    """A policy file that cannot be used; the message names file, field, what it got and what it expected."""


@dataclass(frozen=True, eq=False)
class Policy:
    """A trained policy and all that its actions depend on; the module's docstring says what each part is."""

    layers: tuple[Layer, ...]  # from the observation to the actions before tanh
    obs_scale: ObsScale
    reward: RewardConfig
    frequency_hz: np.ndarray  # (n, 2)
    sensor: SensorParams
    gains: Gains
    rate_hz: float
    spec: ArmSpec
    provenance: Mapping[str, Any]


def action_layout(spec: ArmSpec) -> tuple[str, ...]:
    """Names of the action's entries: the frequency of each spring, scaled from its two limits to [-1, 1]."""
    return tuple(f"spring{k}_hz" for k in range(spec.n_chambers))


def policy_from_actor(
    actor_params: Mapping[str, Any], spec: ArmSpec, reward: RewardConfig, provenance: Mapping[str, Any]
) -> Policy:
    """The policy of an actor that was trained on an arm.

    Args:
        actor_params: nested mappings of arrays, as flax initialises the actor; see `layers_from_flax`.
        spec: the arm; scales, limits, calibration and gains are its own, as in the environment.
        reward: the environment's.
        provenance: how the policy came about, in types that JSON has.

    Raises:
        ValueError: the parameters are not those of an actor for this arm; as a PolicyFileError where an
            array has the wrong shape or is not finite.
    """
    policy = Policy(
        layers=layers_from_flax(actor_params, spec.n_chambers),
        obs_scale=ObsScale.from_spec(spec),
        reward=reward,
        frequency_hz=frequency_range_hz(spec),
        sensor=SensorParams.from_spec(spec),
        gains=Gains.from_spec(spec),
        rate_hz=spec.control.rate_hz,
        spec=spec,
        provenance=provenance,
    )
    return _unpack(_pack(policy), "policy")


def layers_from_flax(actor_params: Mapping[str, Any], n_actions: int) -> tuple[Layer, ...]:
    """The actor's layers without its standard deviations; all that depends on how flax names them.

    Args:
        actor_params: `{"params": {"hidden_0": {"kernel", "bias"}, ..., "head": {"kernel", "bias"}}}`; the
            head's first `n_actions` outputs are the mean, as many more the log standard deviation.
        n_actions: number of actions.

    Raises:
        ValueError: the layers have other names.
    """
    dense = actor_params.get("params", {})
    names = [*(f"hidden_{k}" for k in range(len(dense) - 1)), "head"]
    if set(dense) != set(names):
        raise ValueError(f"actor parameters: got {sorted(dense)}, expected hidden_0, hidden_1, ... and head")
    arrays = [[np.asarray(dense[name][part], np.float32) for part in ("kernel", "bias")] for name in names]
    arrays[-1] = [array[..., :n_actions] for array in arrays[-1]]
    return tuple((weight, bias) for weight, bias in arrays)


def save_policy(path: str | Path, policy: Policy) -> None:
    """Check a policy and write it, whole or not at all; the same policy gives the same bytes.

    Raises:
        PolicyFileError: the policy is not valid, such as a weight that is not finite, or the file cannot be
            written. A file that was there before is then still there.
        TypeError: the provenance holds something that JSON has not.
    """
    path = Path(path)
    arrays = _pack(policy)
    _unpack(arrays, str(path))
    part = path.with_name(path.name + ".part")
    try:
        part.write_bytes(_sealed(arrays))
        part.replace(path)
    except OSError as error:
        raise PolicyFileError(f"{path}: cannot be written: {error.strerror}") from error
    finally:
        if part.exists():
            part.unlink()


def load_policy(path: str | Path) -> Policy:
    """Read a policy and check all of it.

    Raises:
        PolicyFileError: the file cannot be read, is incomplete, damaged, of another program or of a newer
            version, or an entry is missing, unknown, or of the wrong type, shape or range.
    """
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise PolicyFileError(f"{path}: cannot be read: {error.strerror}") from error
    content, digest = data[:-_N_DIGEST], data[-_N_DIGEST:]
    if not content.endswith(_MARK):
        whole = zipfile.is_zipfile(io.BytesIO(data))
        got = "an archive without a policy's mark at its end" if whole else "no complete npz archive"
        expected = "an unchanged file of `python -m train export`"
        raise PolicyFileError(f"{path}: got {got}, {len(data)} bytes, expected {expected}")
    if hashlib.sha256(content).hexdigest().encode() != digest:
        raise PolicyFileError(f"{path}: damaged: its {len(data)} bytes do not have the checksum at their end")
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as npz:
            arrays = {name: np.asarray(npz[name]) for name in npz.files}
    except (ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise PolicyFileError(f"{path}: holds an array that cannot be read: {error}") from error
    return _unpack(arrays, str(path))


def _sealed(arrays: Mapping[str, Any]) -> bytes:
    """The file's bytes. Mark and digest are the zip archive's comment, so any npz reader takes the file."""
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    with zipfile.ZipFile(buffer, "a") as archive:
        archive.comment = _MARK + bytes(_N_DIGEST)
    content = buffer.getvalue()[:-_N_DIGEST]
    return content + hashlib.sha256(content).hexdigest().encode()


class _Entries:
    """The arrays of a file, each checked as it is taken."""

    def __init__(self, arrays: Mapping[str, np.ndarray], source: str):
        self._source, self._arrays, self.left = source, arrays, set(arrays)

    def fail(self, name: str, problem: str) -> NoReturn:
        raise PolicyFileError(f"{self._source}: {name}: {problem}")

    def take(self, name: str, kind: type, *shapes: tuple[int, ...]) -> Any:
        """An array of `kind` in one of the `shapes`, finite; a single value as Python's own type."""
        if name not in self._arrays:
            self.fail(name, "missing")
        array = self._arrays[name]
        self.left.discard(name)
        expected = f"{kind.__name__.rstrip('_')} {' or '.join(map(str, shapes))}"
        if not np.issubdtype(array.dtype, kind) or array.shape not in shapes:
            self.fail(name, f"got {array.dtype.name} {array.shape}, expected {expected}")
        if np.issubdtype(kind, np.floating) and not np.isfinite(array).all():
            self.fail(name, f"got {array[~np.isfinite(array)][0]}, expected finite numbers")
        return array if array.shape else array.item()

    def group(self, name: str, kind: type, *shapes: tuple[int, ...]) -> Any:
        """A dataclass or named tuple of numbers."""
        return kind(*(self.take(f"{name}.{item}", np.float64, *shapes) for item in kind.__annotations__))

    def table(self, name: str) -> dict[str, Any]:
        """A JSON object."""
        text = self.take(name, np.str_, ())
        try:
            return {**json.loads(text)}
        except (ValueError, TypeError):
            self.fail(name, f"got {text[:60]!r}, expected a JSON object")

    def layers(self, n_inputs: int, n_outputs: int) -> tuple[Layer, ...]:
        """Layers that fit together, from so many inputs to so many outputs."""
        layers, n_layers = [], self.take("actor.n_layers", np.integer, ())
        for k in range(n_layers):
            width = n_outputs if k == n_layers - 1 else np.size(self._arrays.get(f"actor.{k}.bias", 0))
            bias = self.take(f"actor.{k}.bias", np.float32, (width,))
            layers.append((self.take(f"actor.{k}.weight", np.float32, (n_inputs, width)), bias))
            n_inputs = width
        return tuple(layers)


def _pack(policy: Policy) -> dict[str, np.ndarray]:
    entries: dict[str, Any] = {
        "schema_version": SCHEMA_VERSION,
        "spec_json": json.dumps(policy.spec.to_dict()),
        "obs_layout": OBS_LAYOUT,
        "action_layout": action_layout(policy.spec),
        "actor.n_layers": len(policy.layers),
        "frequency_hz": policy.frequency_hz,
        "rate_hz": policy.rate_hz,
        "s2r_kind": "none",
        "provenance_json": json.dumps(policy.provenance),
    }
    for k, (weight, bias) in enumerate(policy.layers):
        entries |= {f"actor.{k}.weight": weight, f"actor.{k}.bias": bias}
    for name in ("obs_scale", "reward", "sensor", "gains"):
        group = getattr(policy, name)
        for item in type(group).__annotations__:
            entries[f"{name}.{item}"] = np.asarray(getattr(group, item), np.float64)
    return {name: np.asarray(value) for name, value in entries.items()}


def _unpack(arrays: Mapping[str, np.ndarray], source: str) -> Policy:
    entries = _Entries(arrays, source)
    version = entries.take("schema_version", np.integer, ())
    if version > SCHEMA_VERSION:
        text = f"made by a newer version: schema {version}, this one reads up to {SCHEMA_VERSION}"
        entries.fail("schema_version", text)
    try:
        spec = ArmSpec.from_dict(entries.table("spec_json"), f"{source}: spec_json")
    except SpecError as error:
        raise PolicyFileError(str(error)) from error
    n = spec.n_chambers
    obs_layout = entries.take("obs_layout", np.str_, (OBS_SIZE,))
    names = entries.take("action_layout", np.str_, (n,))
    policy = Policy(
        layers=entries.layers(OBS_SIZE, n),
        obs_scale=entries.group("obs_scale", ObsScale, (6,)),
        reward=entries.group("reward", RewardConfig, ()),
        frequency_hz=entries.take("frequency_hz", np.float64, (n, 2)),
        sensor=entries.group("sensor", SensorParams, (), (n,)),
        gains=entries.group("gains", Gains, (), (n,)),
        rate_hz=entries.take("rate_hz", np.float64, ()),
        spec=spec,
        provenance=entries.table("provenance_json"),
    )
    readable = length_from_frequency(policy.frequency_hz.T, policy.sensor).fault == SensorFault.OK.value
    low_hz, high_hz = policy.frequency_hz.T
    low_kpa, high_kpa = policy.gains.pressure_min_kpa, policy.gains.pressure_max_kpa
    for name, holds, expected in (
        ("schema_version", version >= 1, "at least 1"),
        ("actor.n_layers", len(policy.layers) > 0, "at least 1"),
        ("obs_layout", obs_layout == np.array(OBS_LAYOUT), list(OBS_LAYOUT)),
        ("action_layout", names == np.array(action_layout(spec)), list(action_layout(spec))),
        ("obs_scale.scale", policy.obs_scale.scale > 0.0, "numbers > 0"),
        ("frequency_hz", readable & (low_hz < high_hz), "two that have a length, the lower first"),
        ("gains.pressure_min_kpa", np.less(low_kpa, high_kpa), "less than gains.pressure_max_kpa"),
        ("rate_hz", policy.rate_hz > 0.0, "a number > 0"),
        ("s2r_kind", entries.take("s2r_kind", np.str_, ()) == "none", "none"),
    ):
        if not np.all(holds):
            entries.fail(name, f"got {arrays[name].tolist()}, expected {expected}")
    for name in sorted(entries.left):
        entries.fail(name, f"unknown entry, schema {SCHEMA_VERSION} has none of this name")
    return policy
