"""A run's folder: its config with versions and commit, its checkpoints, its results; and its lock."""

from __future__ import annotations

import contextlib
import fcntl
import functools
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax

from calib.arm import CalibratedArm
from mjx_softarm._support.errors import InputError
from mjx_softarm._support.files import read_json_lines, replacing
from mjx_softarm._support.lazy import LazyModule
from mjx_softarm._support.provenance import provenance, write_json
from mjx_softarm.logs.schema import Log, write_log
from mjx_softarm.sensing.s2r import S2R_FILE
from mjx_softarm.spec import ArmSpec
from train.config import TrainConfig, from_dict, to_dict
from train.demos.demonstrations import Demonstrations, load_demonstrations

if TYPE_CHECKING:
    import orbax.checkpoint as ocp
else:
    ocp = LazyModule("orbax.checkpoint")

CONFIG_FILE, EVALUATION_FILE, METRICS_FILE = "config.json", "evaluation.json", "metrics.jsonl"
DEMONSTRATIONS_FILE, LOCK_FILE = "demonstrations.npz", "training.lock"
N_KEPT = 2  # checkpoints
# Codes that begin a message of TensorStore about files that are cut, changed or absent
_DAMAGE = ("DATA_LOSS", "OUT_OF_RANGE", "NOT_FOUND", "FAILED_PRECONDITION")


class Checkpoints:
    """The newest checkpoints of a run, in the subfolder `checkpoints` of its folder."""

    def __init__(self, run: Path):
        self.run, self.path = run, run / "checkpoints"

    @functools.cached_property
    def _manager(self) -> ocp.CheckpointManager:
        options = ocp.CheckpointManagerOptions(max_to_keep=N_KEPT, enable_async_checkpointing=False)
        return ocp.CheckpointManager(self.path.resolve(), options=options)

    @property
    def epochs(self) -> list[int]:
        """Numbers of epochs behind the complete checkpoints."""
        return sorted(self._manager.all_steps()) if self.path.exists() else []

    @property
    def latest(self) -> int | None:
        """Number of epochs behind the newest complete checkpoint, None if there is none."""
        return max(self.epochs, default=None)

    def rewind(self, epoch: int) -> None:
        """Delete the checkpoints that are later than an epoch."""
        for later in [saved for saved in self.epochs if saved > epoch]:
            self._manager.delete(later)

    def save(self, epoch: int, state: Any, parts: dict[str, Any]) -> None:
        """Write a checkpoint of the state and of `Learner.parts`, after a number of epochs.

        An interrupted write leaves the checkpoint before it in force.
        """
        both = {"state": state, "parts": jax.device_get(parts)}
        saved = {name: ocp.args.StandardSave(item) for name, item in both.items()}
        self._manager.save(epoch, args=ocp.args.Composite(**saved))
        self._manager.wait_until_finished()

    def restore(self, like: Any, epoch: int | None = None) -> Any:
        """Return the state after an epoch, by default the newest, structured as the state or shapes `like`.

        Raises InputError if there is no checkpoint, or it cannot be read.
        """
        shapes = jax.tree.map(_shape_somewhere, like)
        return self._read("state", ocp.args.StandardRestore(shapes), epoch)

    def parts(self) -> dict[str, Any]:
        """Return the newest checkpoint's parts of the learner as NumPy arrays; see `Learner.parts`.

        Raises InputError as `restore` does.
        """
        return self._read("parts", ocp.args.StandardRestore())

    def _read(self, item: str, how: ocp.args.CheckpointArgs, epoch: int | None = None) -> Any:
        epoch = self.latest if epoch is None else epoch
        if epoch is None:
            raise InputError(f"{self.run}: got no checkpoint, expected one; start the run anew")
        try:
            return self._manager.restore(epoch, args=ocp.args.Composite(**{item: how}))[item]
        except Exception as error:
            folder = self.path / str(epoch)
            if _is_damage(folder / item, error):
                earlier = [saved for saved in self.epochs if saved < epoch]
                remedy = f"; without {folder} the run goes back to epoch {earlier[-1]}" if earlier else ""
                raise InputError(
                    f"{folder / item}: got a damaged checkpoint ({str(error).splitlines()[0][:200]}), "
                    f"expected it as it was written{remedy}"
                ) from error
            if not isinstance(error, (ValueError, KeyError)):
                raise
            raise InputError(
                f"{self.run}: got a checkpoint of other parts or sizes, expected this version's; "
                "continue it with the commit that its config.json names"
            ) from error


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
    """Return shape, type and device of an array; by default the first device.

    Otherwise orbax restores to the devices of the saved array, which may not exist here.
    """
    device = jax.sharding.SingleDeviceSharding(jax.devices()[0])
    return jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=getattr(x, "sharding", None) or device)


class Run:
    """The folder of one run.

    It has `config.json` (settings, arm, preset, versions, commit), the models of the arm's calibration,
    `demonstrations.npz` (if it learns from them), `checkpoints/`, `metrics.jsonl`, `evaluation.json`,
    pictures, TensorBoard's event files and, once exported, `policy.npz` and `estimators.npz`.
    """

    def __init__(self, path: Path, config: TrainConfig, arm: CalibratedArm):
        self.path, self.config = path, config
        self.arm = arm._replace(spec=config.env.arm(arm.spec, arm.s2r is not None))
        self.checkpoints = Checkpoints(path)

    @property
    def spec(self) -> ArmSpec:
        """Specification of the arm, with the links of the run."""
        return self.arm.spec

    @classmethod
    def create(
        cls,
        path: Path,
        config: TrainConfig,
        arm: CalibratedArm,
        demonstrations: Log | None = None,
        begins_with: dict[str, Path] | None = None,
        first: tuple[Any, dict[str, Any]] | None = None,
        preset: str | None = None,
    ) -> Run:
        """Start a folder; raise InputError if it holds a run already, or cannot be made.

        Args:
            path, config, arm: folder to make, all settings, and the arm.
            demonstrations: rows of the file of demonstrations, if the run learns from one.
            begins_with: folders of other runs whose parts the first state has, by part.
            first: first state with its parts, if it is not drawn from the seed.
            preset: name of the settings that these began with, if they have one.
        """
        if (path / CONFIG_FILE).exists():
            raise InputError(
                f"{path}: got a folder with a run, expected a new one; continue it with --resume {path}"
            )
        run = cls(path, config, arm)
        try:
            # Write what a run begins with, over what a start that was interrupted has left.
            path.mkdir(parents=True, exist_ok=True)
            arm.write_models(path)
            if demonstrations is not None:
                write_log(path / DEMONSTRATIONS_FILE, demonstrations)
            shutil.rmtree(run.checkpoints.path, ignore_errors=True)
            if first is not None:
                run.checkpoints.save(0, *first)
            # Write the config last: with it the folder is a run.
            data = {
                "preset": preset,
                "train": to_dict(config),
                "spec": run.spec.to_dict(),
                "s2r": arm.s2r is not None,
                "begins_with": {name: str(folder) for name, folder in (begins_with or {}).items()},
                "provenance": provenance("train"),
            }
            write_json(path / CONFIG_FILE, data)
        except OSError as error:
            raise InputError(f"{path}: got {error.strerror!r}, expected to write a new folder") from error
        return run

    @classmethod
    def open(cls, path: Path) -> Run:
        """Open an existing folder; raise InputError if there is no run in it, or a file cannot be read."""
        file = path / CONFIG_FILE
        try:
            data = json.loads(file.read_text("utf-8"))
            config, has_s2r = from_dict(data["train"]), data["s2r"]
            spec = ArmSpec.from_dict(data["spec"], str(file))
        except OSError as error:
            raise InputError(f"{file}: got {error.strerror!r}, expected the folder of a run") from error
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(
                f"{file}: got a damaged config or another version's ({error}), expected this version's; "
                "train it anew, or use the version that the file names"
            ) from error
        arm = CalibratedArm.with_models(spec, path)
        if has_s2r and arm.s2r is None:
            raise InputError(f"{path / S2R_FILE}: got no file, expected the network that the run trains with")
        return cls(path, config, arm)

    def origin(self) -> dict[str, Any]:
        """Return the contents of `config.json`."""
        return json.loads((self.path / CONFIG_FILE).read_text("utf-8"))

    def demonstrations(self) -> Demonstrations | None:
        """Return the demonstrations that the run learns from, or None; see `load_demonstrations`."""
        if not self.config.learner.FROM_DEMONSTRATIONS:
            return None
        return load_demonstrations(self.path / DEMONSTRATIONS_FILE, self.spec)

    def policy(self) -> Any:
        """Return the parameters of the newest checkpoint's policy; see `Checkpoints.parts`."""
        return self.checkpoints.parts()["policy"]

    def check_begins_anew(self) -> None:
        """Raise InputError if a run without a checkpoint had one: it began so, or its metrics go further."""
        done = max((row["epoch"] for row in self.metrics()), default=0)
        # A process may have died after the metrics of an epoch and before its checkpoint.
        if self.origin()["begins_with"] or any(map(self.config.evaluates_after, range(1, done))):
            raise InputError(
                f"{self.checkpoints.path}: got no checkpoint of a run with {done} epochs in {METRICS_FILE}, "
                "expected one; bring the folder back, or train anew with another --out"
            )

    def rewind(self, epoch: int) -> None:
        """Delete checkpoints and metrics later than an epoch, before the run continues from there."""
        self.checkpoints.rewind(epoch)
        rows = [row for row in self.metrics() if row["epoch"] <= epoch]
        with replacing(self.path / METRICS_FILE) as part:
            part.write_text("".join(json.dumps(row) + "\n" for row in rows), "utf-8")

    def log(self, row: dict[str, Any]) -> None:
        """Append a line to `metrics.jsonl`."""
        with (self.path / METRICS_FILE).open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")

    def metrics(self) -> list[dict[str, Any]]:
        """Return the lines of `metrics.jsonl`, up to the first incomplete one."""
        return read_json_lines(self.path / METRICS_FILE)

    def evaluation(self) -> dict[str, Any] | None:
        """Return the figures in `evaluation.json`, None where the run is not finished."""
        file = self.path / EVALUATION_FILE
        return json.loads(file.read_text("utf-8")) if file.exists() else None


@contextlib.contextmanager
def sole_trainer(path: Path) -> Iterator[None]:
    """Lock a folder while training in it, or raise InputError; a killed process releases the lock."""
    with open(path / LOCK_FILE, "w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise InputError(
                f"{path}: got another process that trains in it, expected none; stop it, or wait"
            ) from error
        yield
