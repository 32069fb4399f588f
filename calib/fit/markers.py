"""Markers along the arm: the sections' ends, which the fit uses, and length limits of the chambers.

Markers sit on rings, equally many in each section and evenly spaced within it, the last on the tip's plate.
Each section's last plate has a marker, anywhere on it.

For lengths, at the most bent poses, markers are taken to sit at one site of every ring. Polynomials of fourth
order X(s), Y(s), Z(s) run through them and through that site of the base. The rings turn with the curve
without twisting about it, so any other site, such as that of a chamber, has a parallel curve. A chamber is as
long as its curve within its section.

These polynomials are too smooth for sections that bend independently: on simulated arms without noise
the lengths are off by 5 to 11 mm RMS, and by tens of mm at worst. So they only check the fit.

Source: Simulation Calibration and Validation in Meng et al.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from calib.read.static_poses import StaticPoses
from mjx_softarm._support.errors import InputError
from mjx_softarm.mechanics.params import ArmParams
from mjx_softarm.posture import posture
from mjx_softarm.spec import ArmSpec

ORDER = 4
N_SAMPLES = 50  # points of a curve, per section
N_POSES = 10  # most bent poses, at which lengths are computed
MAX_OFF_PLATE_M = 0.01  # distance of the last marker from the tip's plate, at most
MIN_MARKERS = 5  # markers that a curve needs


class MarkerLimits(NamedTuple):
    """Lengths of the chambers at the most bent poses."""

    pose: np.ndarray  # (n,) indices of the poses, most bent first
    bending_deg: np.ndarray  # (n,) between the tip's plate and the base
    marker_site_m: np.ndarray  # (2,) site of the markers in the rings, x and y
    length_m: np.ndarray  # (n, n_chambers) lengths of the curves
    simulated_m: np.ndarray  # (n, n_chambers) simulated by the calibrated arm at the same pressures
    residual_mm: np.ndarray  # (n,) RMS distance of the markers to the curve
    length_min_m: float
    length_max_m: float


def section_ends(poses: StaticPoses, spec: ArmSpec) -> np.ndarray:
    """Return the markers on the sections' last plates (n, n_sections, 3) [m], NaN where not measured.

    Raises:
        InputError: the sections have unequal numbers, no pose has all, or the last is off the tip's plate.
    """
    n_markers, n_sections = poses.marker_m.shape[1], spec.structure.n_sections
    if n_markers == 0:
        return np.full((poses.n, n_sections, 3), np.nan)
    if n_markers % n_sections:
        raise InputError(f"markers: got {n_markers}, expected as many in each of {n_sections} sections")
    seen = np.flatnonzero(np.isfinite(poses.marker_m).all(axis=(1, 2)))
    if len(seen) == 0:
        raise InputError("markers: got no pose at rest that has them, expected one or more")
    _marker_site(poses.take(seen))
    step = n_markers // n_sections
    return poses.marker_m[:, step - 1 :: step]


def marker_limits(poses: StaticPoses, simulated_m: np.ndarray, spec: ArmSpec) -> MarkerLimits:
    """Compute the range of the chambers' lengths at the most bent poses.

    Args:
        poses: static poses with `MIN_MARKERS` markers or more, which `section_ends` has accepted.
        simulated_m (n, n_chambers) [m]: chamber lengths of the calibrated arm at all poses.
        spec: the arm.

    Raises:
        InputError: the last is off the tip's plate.
    """
    # Choose the most bent poses.
    seen = np.flatnonzero(np.isfinite(poses.marker_m).all(axis=(1, 2)))
    site_m = _marker_site(poses.take(seen))
    axes = posture(spec)
    along = poses.tip_rotation[seen, :, 2] @ axes[:, 2]
    bending_deg = np.degrees(np.arccos(np.clip(along, -1.0, 1.0)))
    order = np.argsort(-bending_deg)[:N_POSES]
    pose = seen[order]
    # Measure chambers along the curves through their markers.
    share = section_shares(spec, poses.marker_m.shape[1] // spec.structure.n_sections)
    curves = [fit_curve(poses.marker_m[k] @ axes, site_m, share) for k in pose]  # as if the arm hung
    length_m = np.stack([chamber_lengths(curve, site_m, spec) for curve, _ in curves])
    return MarkerLimits(
        pose=pose,
        bending_deg=bending_deg[order],
        marker_site_m=site_m,
        length_m=length_m,
        simulated_m=simulated_m[pose],
        residual_mm=1e3 * np.array([np.sqrt(np.mean(np.sum(left**2, axis=1))) for _, left in curves]),
        length_min_m=float(length_m.min()),
        length_max_m=float(length_m.max()),
    )


def section_shares(spec: ArmSpec, n: int) -> np.ndarray:
    """Return how far along the arm n places in each section are, 0 the base, 1 the end.

    Returns:
        Shares (n n_sections + 1,) of the arm's length, the base first.
    """
    length_m = spec.per_section(spec.geometry.section_length_m)
    ends = np.concatenate([[0.0], np.cumsum(length_m)]) / np.sum(length_m)
    return np.interp(np.arange(n * len(length_m) + 1) / n, np.arange(len(ends)), ends)


def fit_curve(marker_m: np.ndarray, site_m: np.ndarray, share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit polynomials of fourth order through the markers of one pose.

    Args:
        marker_m (n_markers, 3) [m]: markers along the arm, the last at the tip.
        site_m (2,) [m]: site of the markers in the rings, where the curve begins in the base.
        share (n_markers + 1,): places of base and markers along the arm, from `section_shares`.

    Returns:
        Coefficients (5, 3), highest power first, in the share s of the arm, 0 at the base and 1 at the tip;
        residuals (n_markers + 1, 3) [m], the base first.
    """
    points = np.vstack([[*site_m, 0.0], marker_m])
    curve = np.polyfit(share, points, ORDER)
    return curve, points - _at(curve, share)


def chamber_lengths(curve: np.ndarray, site_m: np.ndarray, spec: ArmSpec) -> np.ndarray:
    """Return the lengths (n_chambers,) [m] of the chambers parallel to a curve of markers.

    Args:
        curve (5, 3): coefficients from `fit_curve`.
        site_m (2,) [m]: site of the markers in the rings.
        spec: arm, with the sites of the chambers.
    """
    # Turn the rings with the curve.
    n_sections = spec.structure.n_sections
    share = section_shares(spec, N_SAMPLES)
    points = _at(curve, share)
    slope = _at(curve[:-1] * np.arange(ORDER, 0, -1)[:, None], share)
    rotation = _untwisted(-slope / np.linalg.norm(slope, axis=1, keepdims=True))
    # Add up the pieces of each chamber's curve in its section.
    beside = ArmParams.from_spec(spec, np.float64).chamber_site_m.reshape(-1, 2) - site_m
    lines = points + np.einsum("sij,cj->csi", rotation[:, :, :2], beside)
    pieces = np.linalg.norm(np.diff(lines, axis=1), axis=2).reshape(spec.n_chambers, n_sections, N_SAMPLES)
    section = np.arange(spec.n_chambers) // spec.structure.chambers_per_section
    return pieces.sum(axis=2)[np.arange(spec.n_chambers), section]


def _at(curve: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Return points (n, 3) of polynomials (k, 3)."""
    return np.vander(share, len(curve)) @ curve


def _untwisted(up: np.ndarray) -> np.ndarray:
    """Return axes (n, 3, 3) of rings with normals (n, 3), turned as little as possible from ring to ring."""
    rotation = np.eye(3)
    found = []
    for normal in up:
        before = rotation[:, 2]
        x, y, z = np.cross(before, normal)
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        rotation = (np.eye(3) + cross + cross @ cross / (1.0 + before @ normal)) @ rotation
        found.append(rotation)
    return np.stack(found)


def _marker_site(poses: StaticPoses) -> np.ndarray:
    """Return the site of the markers in the rings (2,) [m], from the last one in the tip's frame."""
    seen = np.einsum("nij,ni->nj", poses.tip_rotation, poses.marker_m[:, -1] - poses.tip_m)
    site_m = np.median(seen, axis=0)
    if abs(site_m[2]) > MAX_OFF_PLATE_M:
        raise InputError(
            f"markers: got the last {1e3 * site_m[2]:+.1f} mm above the tip's plate, expected it in the "
            f"plate within {1e3 * MAX_OFF_PLATE_M:.0f} mm: number the markers from base to tip"
        )
    return site_m[:2]
