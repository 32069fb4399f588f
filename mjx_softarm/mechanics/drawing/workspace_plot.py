"""Picture of the reachable workspace, for the paper's arm with the coverage that the paper reports."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator
from scipy.spatial import Delaunay, QhullError

from mjx_softarm.spec import ArmSpec

PAPER_LATERAL_MM, PAPER_VERTICAL_MM = 400.0, 350.0  # paper: coverage of the YZ plane
_GAP_MM = 40.0  # tips closer than this belong to one region of the workspace


def paper_coverage_mm(spec: ArmSpec) -> tuple[float, float] | None:
    """Return the paper's lateral and vertical coverage [mm] of the YZ plane; None for another arm."""
    return (PAPER_LATERAL_MM, PAPER_VERTICAL_MM) if spec == ArmSpec.default() else None


def outline(points: np.ndarray, gap: float) -> np.ndarray:
    """Return the edges (m, 2 ends, 2), in no order, around a cloud of points (n, 2): its alpha shape.

    A hollow is filled where a disc of radius `gap` cannot enter it. A cloud without an area has no edges.
    """
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


def draw_workspace(path: Path, spec: ArmSpec, tip_mm: np.ndarray) -> None:
    """Draw the paper's workspace figure: tips coloured by distance, and their projection with its boundary.

    The tips (n, 3) [mm] in the base frame are those at the combinations of extreme pressures.
    """
    distance = np.linalg.norm(tip_mm, axis=1)
    with rc_context({"font.size": 12, "axes.titlesize": 13, "axes.titlelocation": "left"}):
        figure = Figure(figsize=(13.6, 6.6))
        space = figure.add_axes((-0.01, 0.02, 0.46, 0.86), projection="3d")
        plane = figure.add_axes((0.53, 0.1, 0.38, 0.76))
        scale = figure.add_axes((0.92, 0.1, 0.014, 0.76))
        _draw_space(space, tip_mm, distance)
        _draw_plane(plane, tip_mm, distance, paper_coverage_mm(spec))
        colours = ScalarMappable(Normalize(distance.min(), distance.max()))
        figure.colorbar(colours, cax=scale, label="distance from the base [mm]")
        levels = f"{spec.chambers.pressure_min_kpa:g}, 0 or {spec.chambers.pressure_max_kpa:g} kPa"
        figure.text(0.02, 0.95, f"Tip of the arm “{spec.name}”, every chamber at {levels}", fontsize=15)
        figure.text(0.02, 0.872, "(a) workspace", fontsize=13)
        figure.savefig(path, dpi=150)


def _draw_space(axes, tip_mm: np.ndarray, distance: np.ndarray) -> None:
    """Draw the tips in three dimensions."""
    axes.scatter(*tip_mm.T, c=distance, s=4, alpha=0.6, linewidths=0)
    axes.set(xlabel="x [mm]", ylabel="y [mm]", zlabel="z [mm]")
    axes.set_aspect("equal")
    axes.view_init(elev=16, azim=-55)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_major_locator(MultipleLocator(100.0))
        axis.set_pane_color((0.97, 0.97, 0.98, 1.0))
        axis.labelpad = 8


def _draw_plane(axes, tip_mm: np.ndarray, distance: np.ndarray, paper_mm: tuple[float, float] | None) -> None:
    """Draw the tips on the YZ plane, their outline, and the coverage, beside the paper's if it is given."""
    yz = tip_mm[:, 1:]
    axes.scatter(*yz.T, c=distance, s=4, alpha=0.5, linewidths=0)
    boundary = LineCollection(list(outline(yz, _GAP_MM)), colors="crimson", linewidths=1.6, capstyle="round")
    axes.add_collection(boundary)
    axes.set(xlabel="y [mm]", ylabel="z [mm]", title="(b) projection on the YZ plane")
    axes.set_aspect("equal")
    axes.grid(alpha=0.25)
    axes.xaxis.set_major_locator(MultipleLocator(100.0))
    axes.yaxis.set_major_locator(MultipleLocator(100.0))
    (left, bottom), (right, top) = yz.min(0), yz.max(0)
    margin = 0.12 * max(right - left, top - bottom)
    axes.set(xlim=(left - margin, right + 2.2 * margin), ylim=(bottom - 2.2 * margin, top + margin))
    lateral_mm, vertical_mm = (f" (paper: {size:.0f})" for size in paper_mm) if paper_mm else ("", "")
    _dimension(axes, (left, bottom - margin), (right, bottom - margin), right - left, lateral_mm)
    _dimension(axes, (right + margin, bottom), (right + margin, top), top - bottom, vertical_mm)


def _dimension(axes, start, end, size_mm: float, note: str) -> None:
    """Draw a dimension line with its number and a note."""
    axes.annotate(
        "", start, end, arrowprops={"arrowstyle": "<->", "color": "0.2", "shrinkA": 0, "shrinkB": 0}
    )
    upright = start[0] == end[0]
    axes.annotate(
        f"{size_mm:.0f} mm{note}",
        ((start[0] + end[0]) / 2, (start[1] + end[1]) / 2),
        xytext=(5, 0) if upright else (0, -5),
        textcoords="offset points",
        rotation=90 if upright else 0,
        ha="left" if upright else "center",
        va="center" if upright else "top",
    )
