"""Actuators, fitted to commanded and measured pressures, or to commands and springs.

Pumps and regulators of `mjx_softarm.pneumatics` are driven with the logged commands. The volumes of their
chambers follow the logged spring lengths; no other part of the arm's model takes part. Their pressures are
compared with the measured ones.

Without measured pressures they are compared with those by the springs (`calib.fit.motion.tracks`), through
the lag of the arm itself. Two lags in a row may be exchanged without a change of the answer, so the arm's lag
needs a prior: that of its shape, which springs and tip show without pressures.

A regulator has numbers of all chambers, and a deviation of each chamber from them with a prior: a chamber
whose command never changed has the numbers of the others. Each chamber has an offset.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from calib.fit.blocks import held_out_blocks
from calib.fit.leastsquares import SIGMA_PER_MEDIAN, Model, Problem, Solution, descend, refine, rms_of
from calib.fit.motion.tracks import Runs, Track
from mjx_softarm.pneumatics import LONGEST_DELAY_S, PAPER_PUMP, Actuators, Pump, Regulator
from mjx_softarm.sensing.load import QUANTILE
from mjx_softarm.spec import ArmSpec

BLOCK_S = 10  # clusters of a held-out block: a whole transient
# Starts of the fit [s, s, ranges of the commands a second]; the best one is refined.
LAGS_S, DEAD_TIMES_S, RATES = (0.05, 0.2, 0.5, 1.0), (0.02, 0.1, 0.25, 0.5), (1.5, 0.4)
ALIKE = 1.02  # ratio of errors of starts that fit alike
VOLUME_SHARES = (0.0, 1.0)  # starts, too
DEADBAND_KPA = 0.1
SHARED_PRIOR, CHAMBER_PRIOR = 1.0, 0.05  # standard deviations of logarithms
OFFSET_PRIOR_KPA = 10.0
VOLUME_PRIOR = 1.0  # standard deviation of the share of the volume's effect
# Lag of the springs behind the pressures, over that of the shape behind the springs: some two thirds where
# the backbone alone is damped, as of the paper's arm (0.34 to 0.42 of 0.60 s), one where all parts are damped
# alike.
OF_SHAPE, OF_SHAPE_PRIOR = 0.85, 0.3
# Standard deviation of the logarithms of the lags of stretching and of each section's bending over that. On a
# rod whose parts all creep with 0.25 s, stretching lags by 0.25 s in each section, and bending by 0.10, 0.15
# and 0.20 s.
MODE_PRIOR = 0.5
DIFFERENCE = 0.01  # change of a logarithm, or of an offset [kPa], between two runs
SCALE_KPA, LEAST_SCALE_KPA = 1.0, 0.1  # standard deviation of a mode: first guess, least value
ROUNDS = 2  # fits, each with the scales of the one before
NO_OUTLIERS = 1e9  # errors, in scales, from which the loss is linear
TOLERANCES: dict[str, Any] = {"max_nfev": 60, "ftol": 1e-6, "xtol": 1e-3, "gtol": None}  # end of the fit
# Standard deviation of the logarithms of lag and dead time by the springs, beside that of the fit: the arm is
# more than some lags. Planted lags of 0.5 and 0.8 s of rods came out 1 % above and 4 % below.
BY_SPRINGS = 0.05
# The same of the regulators' lag, as a share of the arm's own lag, from which springs hardly tell it apart.
# Beside arms that lag by 0.25 s, lags of 0.15 s came out as 0.19 and 0.21 s, one of 0.81 s as 0.75 s.
OF_ARM_LAG = 0.3
# Error from which the actuators are of another kind: in the noise of the pressures, and at least
MISFIT, SMALL_MISFIT_KPA = 4.0, 0.3
# Greatest distance of a converged fit from its minimum, in standard deviations, RMS over the parameters; dead
# times are interpolated between ticks, and the errors have kinks there
SMALL_STEP = 0.2
KNOWN = 0.3  # relative half-width of an interval up to which a number counts as known
# Ratio of errors by the springs up to which the simpler actuators are better: hysteresis of the arm looks
# like a deadband. On the paper's pumps regulators leave 1.0 kPa where pumps leave 1.15, on regulators of 1.2
# s 0.3 where pumps leave 0.6.
MARGIN_BY_SPRINGS = 1.2
MARGIN, SMALL_KPA = 1.05, 0.1  # ratio and difference of errors up to which the simpler actuators are better
MAX_RATIO = 2.0  # ratio of held-out to other errors from which there is a warning
_SHARED = ("lag_s", "dead_time_s", "fill_kpa_per_s", "vent_kpa_per_s", "deadband_kpa")
_OWN, _RATES = _SHARED[:4], _SHARED[2:4]  # numbers that differ between chambers; greatest rates


class ArmLag(NamedTuple):
    """Lag of the springs behind the pressures; a lag of zero for measured pressures."""

    lag_s: float
    log_std: float  # standard deviation of its logarithm

    def of_modes(self, x: np.ndarray, n_chambers: int) -> np.ndarray:
        """Return the lags (modes,) [s] of each section's mean and differences.

        Args:
            x (2 + n_sections,): logarithms over the lag: of all modes, of the means, of each section's
                differences.
            n_chambers: number of modes.
        """
        n_sections = len(x) - 2
        lag_s = np.repeat(self.lag_s * np.exp(x[0] + x[2:]), n_chambers // n_sections)
        lag_s[:: n_chambers // n_sections] = self.lag_s * np.exp(x[0] + x[1])
        return lag_s

    @classmethod
    def of_shape(cls, lag_s: float, log_std: float) -> ArmLag:
        """Return the lag to expect from the shape's lag [s] and the standard deviation of its logarithm."""
        return cls(OF_SHAPE * lag_s, float(np.hypot(OF_SHAPE_PRIOR, log_std)))


MEASURED = ArmLag(0.0, SHARED_PRIOR)


@dataclass(frozen=True, eq=False)
class ActuatorFit:
    """Calibrated actuators and whether to trust them. Errors are RMS of simulated less measured pressures."""

    spec: ArmSpec  # arm with the actuators that are better on held-out seconds, and a law that suits them
    chosen: str  # which of `held_out_rms_kpa` these actuators are
    half_width_95: Mapping[str, np.ndarray]  # half-widths (c,) of the 95 % intervals of a regulator's numbers
    in_sample_rms_kpa: float  # seconds of the fit
    held_out_rms_kpa: Mapping[str, float]  # held-out seconds: regulator, pump, the specification, the command
    chamber_rms_kpa: np.ndarray  # (c,) held-out seconds of each chamber
    noise_kpa: float  # noise of the pressures, from row to row
    n_tracks: int
    time_s: float
    arm_lag_s: float | None  # lag of the springs behind the pressures; None where these were measured
    warnings: tuple[str, ...] = ()  # reasons not to trust the fit, each with its remedy
    notes: tuple[str, ...] = ()  # numbers that the logs do not show


def fit_actuators(
    tracks: Sequence[Track], spec: ArmSpec, seed: int = 0, arm: ArmLag = MEASURED
) -> ActuatorFit:
    """Fit regulators, and the flow of pumps; keep those that are better on held-out seconds.

    Args:
        tracks: parts of logs from `find_tracks`, one or more.
        spec: arm, its chambers already calibrated.
        seed: seed that chooses the held-out seconds.
        arm: lag that the arm is expected to have, of tracks with pressures by the springs; `MEASURED` for
            measured ones.
    """
    by_springs, c = arm is not MEASURED, spec.n_chambers
    n_sections = spec.structure.n_sections
    runs = Runs(tracks, 1.0 / spec.control.rate_hz, n_sections if by_springs else None)
    held_out = np.repeat(held_out_blocks(runs.n_seconds, BLOCK_S, seed), c)

    # Fit both kinds; judge them, the specification and the command by the held-out seconds
    regulator, lag_s, solution = fit_regulator(runs, ~held_out, arm, n_sections)
    kinds = {"regulator": (regulator, lag_s), "pump": _fit_pump(runs, ~held_out, spec, arm)}
    kinds["specification"] = spec.actuators, arm.of_modes(np.zeros(2 + n_sections), c)
    errors = {
        name: runs.errors(runs.simulated(actuators.per_chamber(c)), own_s)[0]
        for name, (actuators, own_s) in kinds.items()
    }
    errors["command"] = runs.errors([track.commanded_kpa[:, None] for track in tracks], np.zeros(c))[0]
    rms = {name: rms_of(error[held_out]) for name, error in errors.items()}
    margin = MARGIN_BY_SPRINGS if by_springs else MARGIN
    bound = {name: max(margin * value, value + SMALL_KPA) for name, value in rms.items()}
    simpler = "specification" if rms["specification"] <= bound["pump"] else "pump"
    chosen = simpler if rms[simpler] <= bound["regulator"] else "regulator"

    # Put the better kind into the specification
    of_chambers = np.einsum("smr,mc->csr", errors[chosen][held_out].reshape(-1, c, runs.rows), runs.modes)
    arm_lag_s = float(np.mean(kinds[chosen][1])) if by_springs else None
    # Noise from row to row, by second differences
    change_kpa = np.concatenate([np.diff(track.pressure_kpa, 2, axis=0) for track in tracks])
    done = ActuatorFit(
        spec=with_actuators(spec, kinds[chosen][0]),
        chosen=chosen,
        half_width_95=_half_widths(regulator, solution, arm_lag_s),
        in_sample_rms_kpa=rms_of(errors[chosen][~held_out]),
        held_out_rms_kpa=rms,
        chamber_rms_kpa=np.array([rms_of(error) for error in of_chambers]),
        noise_kpa=float(SIGMA_PER_MEDIAN * np.median(np.abs(change_kpa)) / 6**0.5),
        n_tracks=len(tracks),
        time_s=sum(len(track.pressure_kpa) for track in tracks) / spec.control.rate_hz,
        arm_lag_s=arm_lag_s,
    )
    return dataclasses.replace(done, warnings=_warnings(done, solution), notes=_notes(done))


def with_actuators(spec: ArmSpec, actuators: Actuators) -> ArmSpec:
    """Return the arm with other actuators.

    Behind regulators the law's integral time kp / ki is at least their lag and dead time: a faster integral
    swings. On four rods the springs are then within 0.1 mm after 8 s; with the paper's gains one of the rods
    keeps swinging by 11 mm.
    """
    each = dataclasses.asdict(actuators).items()
    values = {name: tuple(map(float, x)) if np.ndim(x) else float(x) for name, x in each}
    spec = spec.replace(actuators={"kind": actuators.kind, **values})
    if not isinstance(actuators, Regulator) or spec.control.kp_kpa_per_m == 0.0:
        return spec
    slowest = spec.control.kp_kpa_per_m / float(np.mean(actuators.lag_s) + np.mean(actuators.dead_time_s))
    return spec.replace(control={"ki_kpa_per_ms": min(spec.control.ki_kpa_per_ms, slowest)})


def fit_regulator(
    runs: Runs, used: np.ndarray, arm: ArmLag, n_sections: int
) -> tuple[Regulator, np.ndarray, Solution]:
    """Fit regulators to the clusters `used` (n,) bool; return them, the arm's lags (modes,) [s], the fit.

    Parameters are the logarithms of `_SHARED` over the start, the change of the volume's share, offsets (c,)
    [kPa], the logarithms of the chambers' deviations, `_OWN` by c, and those of the arm's lags (2 +
    n_sections,).
    """
    c, n_shared, n_lags = runs.n_chambers, len(_SHARED) + 1, 2 + n_sections
    start = _start(runs, used, arm, n_sections)
    parts = np.cumsum([n_shared, c, len(_OWN) * c])

    def regulators(x: np.ndarray) -> Regulator:
        shared, offset, own, _ = np.split(x, parts, axis=-1)  # x (p,) or (b, p)
        logs = shared[..., : len(_SHARED), None] + np.zeros(c)
        logs[..., : len(_OWN), :] += own.reshape(*x.shape[:-1], len(_OWN), c)
        values = {name: getattr(start, name) * np.exp(logs[..., k, :]) for k, name in enumerate(_SHARED)}
        values["dead_time_s"] = np.minimum(values["dead_time_s"], LONGEST_DELAY_S)
        # On the way to the best share, one a little beyond the bounds keeps a slope
        return Regulator(**values, offset_kpa=offset, volume_share=start.volume_share + shared[..., -1:])

    def lags_s(x: np.ndarray) -> np.ndarray:
        return arm.of_modes(x[-n_lags:], c)

    # Steps of x: none, each shared number, and the offsets of all chambers
    steps = np.zeros((n_shared + 2, parts[-1] + n_lags))
    steps[1:-1, :n_shared] = DIFFERENCE * np.eye(n_shared)
    steps[-1, n_shared : n_shared + c] = DIFFERENCE

    def model(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        kpa = runs.simulated(regulators(x + steps))
        columns = []
        for run in kpa:
            change = (run[:, 1:] - run[:, :1]) / DIFFERENCE  # (n, shared + 1, c)
            # The offset and an own number of a chamber change that chamber's pressure alone
            own = change[:, [-1, *range(len(_OWN))], :, None] * np.eye(c)
            columns.append(np.concatenate([change[:, :-1], own.reshape(len(run), -1, c)], axis=1))
        slopes = [*runs.clusters(runs.followed(columns, lags_s(x)))]
        # Changes by the arm's lags
        here_kpa = [run[:, :1] for run in kpa]
        here = runs.errors(here_kpa, lags_s(x))[0]
        lag_steps = DIFFERENCE * np.eye(len(x))[-n_lags:]
        slopes += [(runs.errors(here_kpa, lags_s(x + step))[0] - here) / DIFFERENCE for step in lag_steps]
        return here[used], np.stack(slopes, axis=-1)[used]

    priors = [SHARED_PRIOR] * len(_SHARED) + [VOLUME_PRIOR] + [OFFSET_PRIOR_KPA] * c
    priors += [CHAMBER_PRIOR] * len(_OWN) * c + [arm.log_std] + [MODE_PRIOR] * (n_lags - 1)
    solution = _fit(model, np.array(priors), runs, used)
    regulator = regulators(solution.x)
    share = float(np.clip(regulator.volume_share, 0.0, 1.0).item())
    return dataclasses.replace(regulator, volume_share=share), lags_s(solution.x), solution


def _fit_pump(runs: Runs, used: np.ndarray, spec: ArmSpec, arm: ArmLag) -> tuple[Pump, np.ndarray]:
    """Fit the flow of pumps, whose valves stay; return them and the arm's lags (modes,) [s]."""
    start = spec.actuators if isinstance(spec.actuators, Pump) else PAPER_PUMP
    n = 3 + spec.structure.n_sections

    def numbers(x: np.ndarray) -> tuple[Pump, np.ndarray]:
        flow = float(start.flow_l_per_min * np.exp(x[0]))
        return dataclasses.replace(start, flow_l_per_min=flow), arm.of_modes(x[1:], spec.n_chambers)

    def errors(x: np.ndarray) -> np.ndarray:
        pump, lag_s = numbers(x)
        return runs.errors(runs.simulated(pump), lag_s)[0][used]

    def model(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        here = errors(x)
        ahead = [(errors(x + step) - here) / DIFFERENCE for step in DIFFERENCE * np.eye(n)]
        return here, np.stack(ahead, axis=-1)

    priors = [SHARED_PRIOR, arm.log_std] + [MODE_PRIOR] * (n - 2)
    return numbers(_fit(model, np.array(priors), runs, used).x)


def _fit(model: Model, prior: np.ndarray, runs: Runs, used: np.ndarray) -> Solution:
    """Minimise the squared errors (n, rows) of a model from x = 0.

    Rows at rest are many and exact; a robust loss would take the transients among them for outliers. The rows
    of a cluster are not independent: together they weigh as one. After a first fit each mode has the scale of
    its errors.
    """
    mode = np.flatnonzero(used) % runs.n_chambers  # of each cluster

    def problem(scale_kpa: np.ndarray) -> Problem:
        scale = runs.rows**0.5 * scale_kpa
        group = np.repeat(mode[:, None], runs.rows, axis=1)
        return Problem(prior, group, scale, min_scale=scale, huber=NO_OUTLIERS)

    x, scale_kpa = np.zeros(len(prior)), np.full(runs.n_chambers, SCALE_KPA)
    for _ in range(ROUNDS):
        now = problem(scale_kpa)
        x = descend(model, x, now.scale, now, "linear", TOLERANCES)
        error = model(x)[0]
        rms_kpa = [rms_of(error[mode == k]) for k in range(runs.n_chambers)]
        scale_kpa = np.maximum(rms_kpa, LEAST_SCALE_KPA)
    return refine(model, x, problem(scale_kpa))


def _start(runs: Runs, used: np.ndarray, arm: ArmLag, n_sections: int) -> Regulator:
    """Return a regulator for all chambers: the best of a grid.

    Of rates that fit alike the greatest are taken: commands that changed slowly do not show a limit.
    """
    rates = max(np.ptp(track.commanded_kpa) for track in runs.tracks) * np.array(RATES)
    grid = np.array([*itertools.product(VOLUME_SHARES, LAGS_S, DEAD_TIMES_S, rates, rates)])
    share, lag_s, dead_time_s, fill, vent = grid.T[..., None]  # (b, 1) each
    offset_kpa = np.median(np.concatenate([t.pressure_kpa - t.commanded_kpa for t in runs.tracks]), axis=0)
    starts = Regulator(lag_s, dead_time_s, fill, vent, DEADBAND_KPA, offset_kpa, volume_share=share)
    errors = runs.errors(runs.simulated(starts), arm.of_modes(np.zeros(2 + n_sections), runs.n_chambers))
    rms = np.array([rms_of(error[used]) for error in errors])
    share, lag_s, dead_time_s, fill, vent = grid[np.argmax(rms <= ALIKE * rms.min())].tolist()
    return Regulator(lag_s, dead_time_s, fill, vent, DEADBAND_KPA, volume_share=share)


def _half_widths(regulator: Regulator, solution: Solution, arm_lag_s: float | None) -> dict[str, np.ndarray]:
    """Return the half-widths (c,) of the numbers of a regulator, of shared and own parameters together.

    Lag and dead time by the springs of an arm, which lags itself, are less sure than the fit says.
    """
    by_springs: dict[str, Any] = {}
    if arm_lag_s is not None:
        of_arm = OF_ARM_LAG * arm_lag_s / np.asarray(regulator.lag_s)
        by_springs = {"lag_s": BY_SPRINGS**2 + of_arm**2, "dead_time_s": BY_SPRINGS**2}
    c, n = np.size(regulator.offset_kpa), len(_SHARED) + 1
    covariance = solution.covariance
    widths = {}
    for k, name in enumerate(_SHARED):
        variance = np.full(c, covariance[k, k]) + by_springs.get(name, 0.0)
        if name in _OWN:
            own = n + c + k * c + np.arange(c)
            variance = variance + covariance[own, own] + 2 * covariance[k, own]
        widths[name] = QUANTILE * np.sqrt(np.maximum(variance, 0.0)) * getattr(regulator, name)
    offset = n + np.arange(c)
    share = QUANTILE * np.sqrt(covariance[len(_SHARED), len(_SHARED)])
    return widths | {
        "offset_kpa": QUANTILE * np.sqrt(covariance[offset, offset]),
        "volume_share": np.full(c, share),
    }


def _warnings(done: ActuatorFit, solution: Solution) -> tuple[str, ...]:
    converged = solution.decrement < 0.5 * SMALL_STEP**2 * len(solution.x)
    said = [] if converged else ["the fit did not converge: log for longer"]
    said += [
        f"{name} is known to {100 * share:.0f} % only: record more poses"
        for name, share in _uncertain(done).items()
        if name not in _RATES
    ]
    held_out = done.held_out_rms_kpa[done.chosen]
    if done.arm_lag_s is None and held_out > max(MISFIT * done.noise_kpa, SMALL_MISFIT_KPA):
        said.append(
            f"the best model of the actuators is {held_out:.2f} kPa off, where the noise of the pressures is "
            f"{done.noise_kpa:.2f} kPa: yours are of another kind, and the intervals may not hold. Expect "
            "larger errors behind a goal that moves (`deploy measure --seconds`), not at stops"
        )
    if held_out > MAX_RATIO * done.in_sample_rms_kpa:
        said.append(
            f"held-out error {held_out:.2f} kPa is more than {MAX_RATIO:g} times the error of the other "
            f"seconds, {done.in_sample_rms_kpa:.2f} kPa: log for longer"
        )
    return tuple(said)


def _notes(done: ActuatorFit) -> tuple[str, ...]:
    return tuple(
        f"{name} is known to {100 * share:.0f} % only: the commands changed more slowly"
        for name, share in _uncertain(done).items()
        if name in _RATES
    )


def _uncertain(done: ActuatorFit) -> dict[str, float]:
    """Return the numbers whose relative half-widths, medians of all chambers, exceed `KNOWN`."""
    actuators = done.spec.actuators
    if not isinstance(actuators, Regulator):
        return {}
    shares = {name: float(np.median(done.half_width_95[name] / getattr(actuators, name))) for name in _OWN}
    return {name: share for name, share in shares.items() if share > KNOWN}
