"""A run's folder: its config with versions and commit, its checkpoints, its results."""

from __future__ import annotations

import functools
import json
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import jax
from jax.experimental.multihost_utils import sync_global_devices

from mjx_softarm._support.errors import InputError
from mjx_softarm._support.files import read_json_lines, replacing
from mjx_softarm._support.lazy import LazyModule
from mjx_softarm._support.provenance import provenance, write_json
from mjx_softarm.logs.files import LogError
from mjx_softarm.logs.pose_pairs import PosePairs, write_pose_pairs
from mjx_softarm.logs.schema import Log, write_log
from mjx_softarm.sensing.held_pressures import (
    PRESSURES_FILE,
    HeldPressures,
    find_pressures,
    save_pressures,
)
from mjx_softarm.sensing.s2r import S2R, S2R_FILE, load_s2r, save_s2r
from mjx_softarm.spec import ArmSpec
from train.agent.registry import LEARNERS, name_of
from train.config import TrainConfig, from_dict, to_dict
from train.demos.demonstrations import Demonstrations, load_demonstrations
from train.epoch.devices import is_first_process
from train.epoch.job import TrainState

if TYPE_CHECKING:
    import orbax.checkpoint as ocp
else:
    ocp = LazyModule("orbax.checkpoint")

N_KEPT = 2
# Codes that begin a message of TensorStore about files that are cut, changed or absent
_DAMAGE = ("DATA_LOSS", "OUT_OF_RANGE", "NOT_FOUND", "FAILED_PRECONDITION")
CHECKPOINTS, DEMONSTRATIONS_FILE = "checkpoints", "demonstrations.npz"


class RunError(InputError):
    """A folder without a usable run; the message names the folder and the fault."""


class Run:
    """The folder of one run.

    `config.json` (settings, arm, calibration, versions, commit), `s2r.npz` and `pressures.npz` (the
    calibration's sim-to-real network and residual pressures, if it has them), `demonstrations.npz` (if it
    learns from them), `checkpoints/`, `metrics.jsonl`, `poses.npz` (of the newest evaluation),
    `evaluation.json`, pictures, TensorBoard's event files and, once exported, `policy.npz` and
    `estimators.npz`.

    Several processes that train together share the folder. All of them open it and save checkpoints. The
    first process alone writes all else.
    """

    def __init__(self, path: Path, config: TrainConfig, spec: ArmSpec, s2r: S2R | None = None):
        self.path, self.config, self.spec, self.s2r = path, config, config.env.arm(spec, s2r is not None), s2r

    @classmethod
    def create(
        cls,
        path: Path,
        config: TrainConfig,
        spec: ArmSpec,
        s2r: S2R | None = None,
        demonstrations: Log | None = None,
        begins_with: dict[str, Path] | None = None,
        first: tuple[TrainState, dict[str, Any]] | None = None,
        held: HeldPressures | None = None,
    ) -> Run:
        """Start a folder.

        Args:
            path: folder to make.
            config: all settings.
            spec: the arm.
            s2r: sim-to-real network of the arm's calibration, if there is one.
            demonstrations: rows of the file of demonstrations, if the run learns from one.
            begins_with: folders of other runs whose parts the first state has, by part.
            first: first state with its parts, if it is not drawn from the seed.
            held: residual pressures of the arm's calibration, if there are some.

        Raises:
            RunError: the folder already holds a run, or cannot be made.
        """
        # Refuse a folder with a run. All processes look before the first one writes.
        if (path / "config.json").exists():
            raise RunError(
                f"{path}: got a folder with a run, expected a new one; continue it with --resume {path}"
            )
        sync_global_devices(f"{path} is free")
        try:
            # Write what a run begins with, over what a start that was interrupted has left.
            if is_first_process():
                path.mkdir(parents=True, exist_ok=True)
                if s2r is not None:
                    save_s2r(path / S2R_FILE, s2r)
                if held is not None:
                    save_pressures(path / PRESSURES_FILE, held)
                if demonstrations is not None:
                    write_log(path / DEMONSTRATIONS_FILE, demonstrations)
                shutil.rmtree(path / CHECKPOINTS, ignore_errors=True)
            sync_global_devices(f"{path} is begun")
            run = cls(path, config, spec, s2r)
            if first is not None:
                run.save(0, *first)
            # Write the config last: with it the folder is a run.
            data = {
                "train": to_dict(config),
                "spec": run.spec.to_dict(),
                "s2r": s2r is not None,
                "begins_with": {name: str(folder) for name, folder in (begins_with or {}).items()},
                "provenance": provenance("train"),
            }
            if is_first_process():
                write_json(path / "config.json", data)
        except OSError as error:
            raise RunError(f"{path}: got {error.strerror!r}, expected to write a new folder") from error
        return run

    @classmethod
    def open(cls, path: Path) -> Run:
        """Open an existing folder.

        Raises:
            RunError: there is no run in it, or its config cannot be read.
            SealedFileError: its sim-to-real network cannot be read.
        """
        file = path / "config.json"
        try:
            data = json.loads(file.read_text("utf-8"))
            config, has_s2r = from_dict(data["train"]), data.get("s2r", False)
            spec = ArmSpec.from_dict(data["spec"], str(file))
        except OSError as error:
            raise RunError(f"{file}: got {error.strerror!r}, expected the folder of a run") from error
        except (ValueError, KeyError, TypeError) as error:
            raise RunError(
                f"{file}: got a damaged config or another version's ({error}), expected this version's; "
                "train it anew, or use the version that the file names"
            ) from error
        s2r = load_s2r(path / S2R_FILE, spec.n_springs) if has_s2r else None
        return cls(path, config, spec, s2r)

    @functools.cached_property
    def _manager(self) -> ocp.CheckpointManager:
        options = ocp.CheckpointManagerOptions(max_to_keep=N_KEPT, enable_async_checkpointing=False)
        return ocp.CheckpointManager((self.path / CHECKPOINTS).resolve(), options=options)

    def demonstrations(self) -> Demonstrations | None:
        """Return the demonstrations that the run learns from, or None.

        Raises:
            RunError: its file cannot be read.
        """
        if not LEARNERS[name_of(self.config.learner)].from_demonstrations:
            return None
        try:
            return load_demonstrations(self.path / DEMONSTRATIONS_FILE, self.spec)
        except LogError as error:
            raise RunError(str(error)) from error

    def held_pressures(self) -> HeldPressures | None:
        """Return the residual pressures of the arm's calibration, or None.

        Raises:
            SealedFileError: the file cannot be read.
        """
        spec = self.spec
        return find_pressures(self.path, spec.structure.n_sections, spec.n_springs, spec.n_chambers)

    @property
    def latest_epoch(self) -> int | None:
        """Number of epochs behind the newest complete checkpoint, None if there is none."""
        return max(self.epochs, default=None)

    @property
    def epochs(self) -> list[int]:
        """Numbers of epochs behind the complete checkpoints."""
        return sorted(self._manager.all_steps()) if (self.path / CHECKPOINTS).exists() else []

    def check_begins_anew(self) -> None:
        """Check that a run without a checkpoint was stopped before its first one.

        Raises:
            RunError: it had a checkpoint: it began with another run's, or its metrics go further.
        """
        done = max((row["epoch"] for row in self.metrics()), default=0)
        begins_with = json.loads((self.path / "config.json").read_text("utf-8")).get("begins_with")
        # A process may have died after the metrics of an epoch and before its checkpoint.
        if begins_with or any(map(self.config.evaluates_after, range(1, done))):
            raise RunError(
                f"{self.path / CHECKPOINTS}: got no checkpoint of a run with {done} epochs in metrics.jsonl, "
                "expected one; bring the folder back, or train anew with another --out"
            )

    def rewind(self, epoch: int) -> None:
        """Delete checkpoints and metrics later than an epoch, before the run continues from there."""
        for later in [saved for saved in self.epochs if saved > epoch]:
            self._manager.delete(later)
        if not is_first_process():
            return
        rows = [row for row in self.metrics() if row["epoch"] <= epoch]
        with replacing(self.path / "metrics.jsonl") as part:
            part.write_text("".join(json.dumps(row) + "\n" for row in rows), "utf-8")

    def save(self, epoch: int, state: TrainState, parts: dict[str, Any]) -> None:
        """Write a checkpoint; an interrupted write leaves the one before it in force.

        Args:
            epoch: number of epochs done.
            state: all that the run needs to go on.
            parts: what export and other runs need of the learner; see `Learner.parts`.
        """
        both = {"state": state, "parts": jax.device_get(parts)}
        saved = {name: ocp.args.StandardSave(item) for name, item in both.items()}
        self._manager.save(epoch, args=ocp.args.Composite(**saved))
        self._manager.wait_until_finished()

    def restore(self, like: TrainState) -> tuple[int, TrainState]:
        """Return the newest checkpoint: epochs done, and state.

        Args:
            like: a state, or its shapes, structured as the run's.

        Raises:
            RunError: there is no checkpoint, or it has another structure.
        """
        shapes = ocp.args.StandardRestore(jax.tree.map(_shape_somewhere, like))
        epoch, state = self._newest("state", shapes)
        return epoch, cast(TrainState, state)

    def parts(self) -> dict[str, Any]:
        """Return the newest checkpoint's parts of the learner as NumPy arrays; see `Learner.parts`.

        Raises:
            RunError: there is no checkpoint, or it is another version's.
        """
        return self._newest("parts", ocp.args.StandardRestore())[1]

    def policy(self) -> Any:
        """Return the parameters of the newest checkpoint's policy as NumPy arrays; see `parts`."""
        return self.parts()["policy"]

    def _newest(self, item: str, how: ocp.args.CheckpointArgs) -> tuple[int, Any]:
        """Return the number of epochs behind the newest checkpoint, and an item of it."""
        epoch = self.latest_epoch
        if epoch is None:
            raise RunError(f"{self.path}: got no checkpoint, expected one; start the run anew")
        try:
            return epoch, self._manager.restore(epoch, args=ocp.args.Composite(**{item: how}))[item]
        except Exception as error:
            folder = self.path / CHECKPOINTS / str(epoch)
            if _is_damage(folder / item, error):
                earlier = [saved for saved in self.epochs if saved < epoch]
                remedy = f"; without {folder} the run goes back to epoch {earlier[-1]}" if earlier else ""
                raise RunError(
                    f"{folder / item}: got a damaged checkpoint ({str(error).splitlines()[0][:200]}), "
                    f"expected it as it was written{remedy}"
                ) from error
            if not isinstance(error, (ValueError, KeyError)):
                raise
            raise RunError(
                f"{self.path}: got a checkpoint of other parts or sizes, expected this version's; "
                "continue it with the commit that its config.json names"
            ) from error

    def log(self, row: dict[str, Any]) -> None:
        """Append a line to `metrics.jsonl`."""
        if is_first_process():
            with (self.path / "metrics.jsonl").open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")

    def write_poses(self, *results: Any) -> None:
        """Write poses at goals, and around the circle if an evaluation found them, for the view."""
        if is_first_process():
            found = [getattr(result, "reached", result) for result in results]
            sets = {
                name: PosePairs(at.goal, at.pose, (at.saturated_chambers > 0) | ~at.settled)
                for name, at in zip(("goals", "circle"), found, strict=False)
            }
            write_pose_pairs(self.path, sets)

    def metrics(self) -> list[dict[str, Any]]:
        """Return the lines of `metrics.jsonl`, up to the first incomplete one."""
        return read_json_lines(self.path / "metrics.jsonl")


def _is_damage(folder: Path, error: Exception) -> bool:
    """Return whether the files of a checkpoint's item are damaged, rather than those of another version."""
    chain = (error, error.__cause__)  # the reading of an array fails in a thread
    unread = isinstance(error, (UnicodeDecodeError, json.JSONDecodeError, FileNotFoundError))
    return (
        unread
        or not (folder / "_METADATA").exists()
        or any(code in str(one) for one in chain if one is not None for code in _DAMAGE)
    )


def _shape_somewhere(x: Any) -> jax.ShapeDtypeStruct:
    """Return shape, type and device of an array; by default this process's first device.

    Otherwise orbax restores to the devices of the saved array, which may not exist here.
    """
    shape = ocp.utils.to_shape_dtype_struct(x)
    assert isinstance(shape, jax.ShapeDtypeStruct)  # a state has no plain numbers
    if shape.sharding is not None:
        return shape
    device = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
    return jax.ShapeDtypeStruct(shape.shape, shape.dtype, sharding=device)
