"""Command line: `python -m mjx_softarm spec | picture | workspace | firmware`."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mjx_softarm._support import cli
from mjx_softarm._support.errors import InputError, missing, needing
from mjx_softarm.arms import shipped_arm
from mjx_softarm.mechanics.excitation import random_pressures
from mjx_softarm.spec import ArmSpec

FIRMWARE = Path(__file__).parent / "deploy" / "drivers" / "firmware" / "firmware.ino"
FAR_LIMIT = 0.25  # distance of a limit from the springs' range, as a share of it, that is reported; by hand
MAX_COMBINATIONS, N_RANDOM = 1_000_000, 3**9  # of pressures; as many as those of the paper's arm


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit status."""
    about = (
        "A pneumatic soft arm in MuJoCo and JAX: its specification, its picture, its workspace, its board."
    )
    commands = {"spec": _spec, "picture": _picture, "workspace": _workspace, "firmware": _firmware}
    return cli.main("python -m mjx_softarm", about, commands, arguments)


def _spec(arm: str = "paper", out: Path = Path("arm.toml")) -> int:
    """Write an arm's specification, every number with its unit and its source, to start your own from.

    Args:
        arm: paper, sopra, stiff-flop or four-chamber
        out: file to write
    """
    if out.exists():
        raise InputError(f"--out: got {out}, which exists already, expected a new file")
    out.write_text(shipped_arm(arm), "utf-8")
    print(f"wrote {out}; edit it, its name first, and use it with --spec {out}")
    return 0


def _picture(
    spec: cli.SpecFile = None, pressures: tuple[float, ...] = (0.0,), out: Path = Path("arm.png")
) -> int:
    """Draw the arm in equilibrium at given pressures.

    Without a display, set MUJOCO_GL to egl or osmesa.

    Args:
        pressures: [kPa] one for all chambers, or one for each, section by section from the base
        out: PNG file to write
    """
    # Refuse pressures that the arm cannot have, and an environment that cannot draw.
    arm = ArmSpec.of(spec)
    if len(pressures) not in (1, arm.n_chambers):
        raise InputError(f"--pressures: got {len(pressures)} numbers, expected 1 or {arm.n_chambers}")
    low, high = arm.chambers.pressure_min_kpa, arm.chambers.pressure_max_kpa
    for value in pressures:
        if not low <= value <= high:
            raise InputError(f"--pressures: got {value:g}, expected {low:g} to {high:g} kPa")
    _import_mujoco()
    from PIL import Image

    from mjx_softarm.mechanics.drawing.render import Renderer
    from mjx_softarm.mechanics.mjcf import build_model
    from mjx_softarm.mechanics.settle import SettleResult
    from mjx_softarm.mechanics.workspace import settle_many

    # Settle the arm, then draw it as it stands.
    settled = settle_many(arm, np.broadcast_to(pressures, (1, arm.n_chambers)))
    if not settled.settled[0]:
        where, check = "--pressures", ""
        if not any(pressures):
            where, check = str(spec or arm.name), "; check the units of its masses, lengths and stiffnesses"
        raise InputError(
            f"{where}: got an arm that does not settle, with {settled.residual[0]:g} N or N m left: "
            f"{SettleResult(settled.result[0]).text}; expected an equilibrium{check}"
        )
    with Renderer(build_model(arm)) as renderer:
        image = renderer.draw(np.asarray(settled.q[0]))
    Image.fromarray(image).save(out, "PNG")
    x, y, z = 1e3 * settled.tip_position_m[0]
    print(f"wrote {out}; tip at x {x:.1f}, y {y:.1f}, z {z:.1f} mm")
    return 0


def _workspace(spec: cli.SpecFile = None, out: Path = Path(".")) -> int:
    """Draw the reachable workspace, and print its coverage of the YZ plane.

    The tip is computed at every combination of lowest, zero and highest pressure: 19,683 for nine chambers.
    With more than 12 chambers there are too many: then it is computed at 19,683 sets of random pressures.

    Args:
        out: folder for workspace.png
    """
    # Refuse an environment that cannot draw.
    arm = ArmSpec.of(spec)
    _import_mujoco()
    with needing("sim", "drawing"):
        from mjx_softarm.mechanics.drawing import workspace_plot as plot
    from mjx_softarm.mechanics.workspace import extreme_poses, settle_many

    # Settle at all combinations, or at as many random pressures.
    out.mkdir(parents=True, exist_ok=True)
    every = 3**arm.n_chambers <= MAX_COMBINATIONS
    settled = extreme_poses(arm) if every else settle_many(arm, random_pressures(arm, N_RANDOM, 0))
    n, n_lost = len(settled.settled), int(np.sum(~settled.settled))
    if n_lost == n:
        raise InputError(f"{spec}: got an arm that settles at no combination of pressures, expected some")
    # Draw the tips, and print how far they reach.
    tip_mm = 1e3 * np.asarray(settled.tip_position_m, float)[settled.settled]
    lateral, vertical = np.ptp(tip_mm[:, 1]), np.ptp(tip_mm[:, 2])
    plot.draw_workspace(out / "workspace.png", arm, tip_mm)
    kind = "combinations of" if every else "random"
    print(f"{n:,} {kind} pressures, {n_lost:,} not settled ({n_lost / n:.2%})")
    paper_mm = plot.paper_coverage_mm(arm)
    beside = [f", paper {size_mm:.1f} mm" for size_mm in paper_mm] if paper_mm else ["", ""]
    print("coverage of the YZ plane")
    print(f"  lateral (y)   {lateral:6.1f} mm{beside[0]}")
    print(f"  vertical (z)  {vertical:6.1f} mm{beside[1]}")
    _tell_lengths(arm, np.asarray(settled.spring_m, float)[settled.settled])
    print(f"wrote {out / 'workspace.png'}")
    return 0


def _tell_lengths(spec: ArmSpec, spring_m: np.ndarray) -> None:
    """Print the lengths that springs (n, n_springs) [m] reach, and say where their limits are far from it."""
    low_m, high_m = spec.springs.length_min_m, spec.springs.length_max_m
    n = spec.structure.n_sections if isinstance(low_m, tuple) or isinstance(high_m, tuple) else 1
    for k, part in enumerate(np.split(spring_m, n, axis=1)):
        shortest, longest = part.min(), part.max()
        low, high = spec.per_section(low_m)[k], spec.per_section(high_m)[k]
        far = max(abs(low - shortest), abs(high - longest)) > FAR_LIMIT * (longest - shortest)
        print(
            f"springs{f' of section {k}' if n > 1 else ''}: springs.length_min_m = {shortest:.3f} and "
            f"length_max_m = {longest:.3f} would hold what they reach; now {low:.3f} and {high:.3f}"
            f"{': change them' if far else ''}"
        )


def _firmware(spec: cli.SpecFile = None, out: Path = Path("softarm")) -> int:
    """Write the reference firmware of a microcontroller, with the numbers of an arm.

    Args:
        out: folder of the sketch, which has the folder's name
    """
    arm, sketch = ArmSpec.of(spec), out / f"{out.name}.ino"
    if sketch.exists():
        raise InputError(f"--out: got {sketch}, which exists already, expected a new folder")
    numbers = {
        "int N_SPRINGS": f"{arm.n_springs}",
        "int N_CHAMBERS": f"{arm.n_chambers}",
        "float MIN_KPA": f"{arm.chambers.pressure_min_kpa}f",
        "float MAX_KPA": f"{arm.chambers.pressure_max_kpa}f",
    }
    text = FIRMWARE.read_text("utf-8")
    for name, value in numbers.items():
        text = re.sub(rf"(?<=constexpr {name} = )[^;]+", value, text)
    out.mkdir(parents=True, exist_ok=True)
    sketch.write_text(text, "utf-8")
    print(f"wrote {sketch}; put in the pins and converters of your board before you compile it")
    return 0


def _import_mujoco() -> None:
    """Import MuJoCo, which reads MUJOCO_GL as it is imported."""
    try:
        import mujoco  # noqa: F401
    except ModuleNotFoundError as error:
        raise InputError(f"drawing: {missing(error, 'sim')}") from error
    except (ImportError, AttributeError, RuntimeError) as error:
        asked = os.environ.get("MUJOCO_GL", "")
        raise InputError(
            f"MUJOCO_GL: got {asked!r} ({error}), expected a name with which MuJoCo can be imported"
        ) from error


if __name__ == "__main__":
    sys.exit(main())
