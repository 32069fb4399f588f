"""Command line: `python -m mjx_softarm {spec,picture,workspace}`."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import NoReturn

import numpy as np

from mjx_softarm.spec import ArmSpec, SpecError

PAPER_LATERAL_MM, PAPER_VERTICAL_MM = 400.0, 350.0  # paper: coverage on the YZ plane
MAX_COMBINATIONS = 1_000_000
_GAP_MM = 40.0  # tips closer than this belong to one region of the workspace
_ERROR = 2


class CommandError(Exception):
    """The command cannot be carried out; the message is all that its user needs."""


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        self.exit(_ERROR, f"{self.prog}: error: {message} (--help tells more)\n")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code: 0, or 2 after an error of one line on stderr."""
    args = _parser().parse_args(argv)
    try:
        args.run(args)
    except (CommandError, SpecError, OSError) as error:
        print(f"mjx_softarm {args.command}: error: {error}", file=sys.stderr)
        return _ERROR
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="python -m mjx_softarm",
        description="A pneumatic soft arm in MuJoCo and JAX: its specification, its picture, its workspace.",
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    arm = _Parser(add_help=False)
    arm.add_argument(
        "--spec", metavar="ARM.toml", type=Path, help="the arm's specification; default: the paper's arm"
    )

    spec = commands.add_parser(
        "spec",
        help="write the default arm's specification, to start your own from",
        description="Write the default arm's specification: every number with its unit and its source.",
    )
    spec.add_argument(
        "--out", type=Path, default=Path("arm.toml"), help="file to write; default: %(default)s"
    )
    spec.add_argument("--force", action="store_true", help="replace the file if there is one")
    spec.set_defaults(run=_run_spec)

    picture = commands.add_parser(
        "picture",
        parents=[arm],
        help="draw the arm at rest at given pressures",
        description="Draw the arm at rest at given pressures. Without a display, MUJOCO_GL=egl or "
        "MUJOCO_GL=osmesa chooses how.",
    )
    picture.add_argument(
        "--pressures",
        metavar="KPA",
        type=float,
        nargs="+",
        default=[0.0],
        help="one pressure for all chambers, or one for each, section by section from the base; default: 0",
    )
    picture.add_argument(
        "--out", type=Path, default=Path("arm.png"), help="PNG to write; default: %(default)s"
    )
    picture.set_defaults(run=_run_picture)

    workspace = commands.add_parser(
        "workspace",
        parents=[arm],
        help="compute and draw the reachable workspace",
        description="Compute the tip at every combination of lowest, zero and highest pressure (19,683 for "
        "nine chambers), draw it, and compare its coverage of the YZ plane with the paper's.",
    )
    workspace.add_argument(
        "--out", metavar="DIR", type=Path, default=Path("."), help="folder for workspace.png; default: here"
    )
    workspace.set_defaults(run=_run_workspace)
    return parser


def _run_spec(args: argparse.Namespace) -> None:
    if args.out.exists() and not args.force:
        raise CommandError(f"{args.out}: exists already; --force replaces it")
    text = resources.files("mjx_softarm").joinpath("arms/paper.toml").read_text("utf-8")
    args.out.write_text(text, "utf-8")
    print(f"wrote {args.out}; edit it and use it with --spec {args.out}")


def _run_picture(args: argparse.Namespace) -> None:
    spec = _read_spec(args.spec)
    _check_pressures(spec, args.pressures)
    _import_mujoco()
    from mjx_softarm.mechanics.mjcf import build_model
    from mjx_softarm.mechanics.render import Renderer, RenderError, write_png
    from mjx_softarm.mechanics.workspace import settle_many

    pressure_kpa = np.broadcast_to(np.asarray(args.pressures), (1, spec.n_chambers))
    rest = settle_many(spec, pressure_kpa)
    if not rest.settled[0]:
        raise CommandError(
            f"the arm does not settle at these pressures: {rest.residual[0]:g} N or N m are left"
        )
    try:
        with Renderer(build_model(spec)) as renderer:
            image = renderer.draw(np.asarray(rest.q[0]))
    except RenderError as error:
        raise CommandError(str(error)) from error
    write_png(args.out, image)
    x, y, z = 1e3 * rest.tip_position_m[0]
    print(f"wrote {args.out}; tip at x {x:.1f}, y {y:.1f}, z {z:.1f} mm")


def _run_workspace(args: argparse.Namespace) -> None:
    spec = _read_spec(args.spec)
    if 3**spec.n_chambers > MAX_COMBINATIONS:
        raise CommandError(f"3^{spec.n_chambers} combinations of pressures are too many to compute")
    _import_mujoco()
    try:
        import matplotlib
    except ImportError as error:
        raise CommandError(f"drawing needs matplotlib (pip install matplotlib): {error}") from error
    matplotlib.use("Agg")
    from mjx_softarm.mechanics.workspace import extreme_poses

    args.out.mkdir(parents=True, exist_ok=True)
    found = extreme_poses(spec)
    n, n_lost = len(found.settled), int(np.sum(~found.settled))
    if n_lost == n:
        raise CommandError("the arm settles at none of the combinations of pressures")
    tip_mm = 1e3 * np.asarray(found.tip_position_m, float)[found.settled]
    lateral, vertical = np.ptp(tip_mm[:, 1]), np.ptp(tip_mm[:, 2])
    path = args.out / "workspace.png"
    _draw_workspace(path, spec, tip_mm)
    print(f"{n:,} combinations of pressures, {n_lost:,} not settled ({n_lost / n:.2%})")
    print("coverage of the YZ plane   arm      paper")
    print(f"  lateral (y)            {lateral:6.1f}   {PAPER_LATERAL_MM:6.1f} mm")
    print(f"  vertical (z)           {vertical:6.1f}   {PAPER_VERTICAL_MM:6.1f} mm")
    print(f"wrote {path}")


def _read_spec(path: Path | None) -> ArmSpec:
    return ArmSpec.default() if path is None else ArmSpec.from_toml(path)


def _import_mujoco() -> None:
    """Import MuJoCo, which reads MUJOCO_GL as it is imported."""
    try:
        import mujoco  # noqa: F401
    except (ImportError, AttributeError, RuntimeError) as error:
        asked = os.environ.get("MUJOCO_GL", "")
        raise CommandError(f"MuJoCo cannot be imported with MUJOCO_GL={asked!r}: {error}") from error


def _check_pressures(spec: ArmSpec, pressures: Sequence[float]) -> None:
    if len(pressures) not in (1, spec.n_chambers):
        raise CommandError(f"--pressures: got {len(pressures)} numbers, expected 1 or {spec.n_chambers}")
    low, high = spec.chambers.pressure_min_kpa, spec.chambers.pressure_max_kpa
    for value in pressures:
        if not low <= value <= high:
            raise CommandError(f"--pressures: got {value:g}, expected {low:g} to {high:g} kPa")


def outline(points: np.ndarray, gap: float) -> np.ndarray:
    """The edges around a cloud of points, hollows included: its alpha shape.

    Args:
        points (n, 2): the cloud.
        gap: a hollow that a disc of this radius cannot enter is filled.

    Returns:
        Edges (m, 2 ends, 2) in no order; none where the cloud has no area.
    """
    from scipy.spatial import Delaunay, QhullError

    try:
        triangles = Delaunay(points).simplices  # (t, 3)
    except (QhullError, ValueError):  # fewer than three points, or all on a line
        return np.empty((0, 2, 2))
    corners = points[triangles]
    side, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = 0.5 * np.abs(side[:, 0] * other[:, 1] - side[:, 1] * other[:, 0])
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1)  # (t, 3)
    kept = triangles[np.prod(sides, axis=1) < 4.0 * area * gap]  # by the radius of the circumcircle
    edges = np.sort(np.concatenate([kept[:, [0, 1]], kept[:, [1, 2]], kept[:, [2, 0]]]), axis=1)
    edges, n_triangles = np.unique(edges, axis=0, return_counts=True)
    return points[edges[n_triangles == 1]]


def _draw_workspace(path: Path, spec: ArmSpec, tip_mm: np.ndarray) -> None:
    """The paper's workspace figure: tips coloured by distance, and their projection with its boundary."""
    import matplotlib.pyplot as plt
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    distance = np.linalg.norm(tip_mm, axis=1)
    with plt.rc_context({"font.size": 12, "axes.titlesize": 13, "axes.titlelocation": "left"}):
        figure = plt.figure(figsize=(13.6, 6.6))
        space = figure.add_axes((-0.01, 0.02, 0.46, 0.86), projection="3d")
        plane = figure.add_axes((0.53, 0.1, 0.38, 0.76))
        scale = figure.add_axes((0.92, 0.1, 0.014, 0.76))
        _draw_space(space, tip_mm, distance)
        _draw_plane(plane, tip_mm, distance)
        colours = ScalarMappable(Normalize(distance.min(), distance.max()))
        figure.colorbar(colours, cax=scale, label="distance from the base [mm]")
        levels = f"{spec.chambers.pressure_min_kpa:g}, 0 or {spec.chambers.pressure_max_kpa:g} kPa"
        figure.text(0.02, 0.95, f"Tip of the arm “{spec.name}”, every chamber at {levels}", fontsize=15)
        figure.text(0.02, 0.872, "(a) workspace", fontsize=13)
        figure.savefig(path, dpi=150)
        plt.close(figure)


def _draw_space(axes, tip_mm: np.ndarray, distance: np.ndarray) -> None:
    """Tips in three dimensions."""
    axes.scatter(*tip_mm.T, c=distance, s=4, alpha=0.6, linewidths=0)
    axes.set(xlabel="x [mm]", ylabel="y [mm]", zlabel="z [mm]")
    axes.set_aspect("equal")
    axes.view_init(elev=16, azim=-55)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_major_locator(_ticks())
        axis.set_pane_color((0.97, 0.97, 0.98, 1.0))
        axis.labelpad = 8


def _draw_plane(axes, tip_mm: np.ndarray, distance: np.ndarray) -> None:
    """Tips projected on the YZ plane, their outline, and the coverage beside the paper's."""
    from matplotlib.collections import LineCollection

    yz = tip_mm[:, 1:]
    axes.scatter(*yz.T, c=distance, s=4, alpha=0.5, linewidths=0)
    boundary = LineCollection(list(outline(yz, _GAP_MM)), colors="crimson", linewidths=1.6, capstyle="round")
    axes.add_collection(boundary)
    axes.set(xlabel="y [mm]", ylabel="z [mm]", title="(b) projection on the YZ plane")
    axes.set_aspect("equal")
    axes.grid(alpha=0.25)
    axes.xaxis.set_major_locator(_ticks())
    axes.yaxis.set_major_locator(_ticks())
    (left, bottom), (right, top) = yz.min(0), yz.max(0)
    margin = 0.12 * max(right - left, top - bottom)
    axes.set(xlim=(left - margin, right + 2.2 * margin), ylim=(bottom - 2.2 * margin, top + margin))
    _dimension(axes, (left, bottom - margin), (right, bottom - margin), right - left, PAPER_LATERAL_MM)
    _dimension(axes, (right + margin, bottom), (right + margin, top), top - bottom, PAPER_VERTICAL_MM)


def _dimension(axes, start, end, size_mm: float, paper_mm: float) -> None:
    """A dimension line with its number and the paper's."""
    axes.annotate(
        "", start, end, arrowprops={"arrowstyle": "<->", "color": "0.2", "shrinkA": 0, "shrinkB": 0}
    )
    upright = start[0] == end[0]
    axes.annotate(
        f"{size_mm:.0f} mm (paper: {paper_mm:.0f})",
        ((start[0] + end[0]) / 2, (start[1] + end[1]) / 2),
        xytext=(5, 0) if upright else (0, -5),
        textcoords="offset points",
        rotation=90 if upright else 0,
        ha="left" if upright else "center",
        va="center" if upright else "top",
    )


def _ticks():
    from matplotlib.ticker import MultipleLocator

    return MultipleLocator(100.0)


if __name__ == "__main__":
    sys.exit(main())
