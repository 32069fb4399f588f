"""Actuators, fitted to commanded and measured pressures.

Pumps and regulators of `mjx_softarm.pneumatics` are driven with the logged commands. The volumes of their
chambers follow the logged spring lengths; no other part of the arm's model takes part. Their pressures are
compared with the measured ones.

A regulator has numbers of all chambers, and a deviation of each chamber from them with a prior: a chamber
whose command never changed has the numbers of the others. Each chamber has an offset.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.fit.blocks import held_out_blocks
from calib.fit.leastsquares import (
    NOT_CONVERGED,
    Model,
    Problem,
    Solution,
    descend,
    rms_of,
    solution_at,
)
from calib.fit.motion.tracks import Runs, Track
from mjx_softarm.pneumatics import LONGEST_DELAY_S, PAPER_PUMP, Actuators, Pump, Regulator
from mjx_softarm.sensing.load import QUANTILE
from mjx_softarm.spec import ArmSpec

BLOCK_S = 10  # clusters of a held-out block: a whole transient
# Starts of the fit [s, s, ranges of the commands a second]; the best one is refined.
LAGS_S, DEAD_TIMES_S, RATES = (0.05, 0.2, 0.5, 1.0), (0.02, 0.1, 0.25, 0.5), (1.5, 0.4)
ALIKE = 1.02  # ratio of errors of starts that fit alike
DEADBAND_KPA = 0.1
SHARED_PRIOR, CHAMBER_PRIOR = 1.0, 0.05  # standard deviations of logarithms
OFFSET_PRIOR_KPA = 10.0
DIFFERENCE = 0.01  # change of a logarithm, or of an offset [kPa], between two runs
SCALE_KPA = 1.0  # standard deviation of a pressure, against which the priors weigh
NO_OUTLIERS = 1e9  # errors, in scales, from which the loss is linear
TOLERANCES: dict[str, Any] = {"max_nfev": 40, "ftol": 1e-5, "xtol": 1e-3, "gtol": None}  # end of the fit
KNOWN = 0.3  # relative half-width of an interval up to which a number counts as known
MARGIN, SMALL_KPA = 1.05, 0.1  # ratio and difference of errors up to which the simpler actuators are better
MAX_RATIO = 2.0  # ratio of held-out to other errors from which there is a warning
_SHARED = ("lag_s", "dead_time_s", "fill_kpa_per_s", "vent_kpa_per_s", "deadband_kpa")
_OWN, _RATES = _SHARED[:4], _SHARED[2:4]  # numbers that differ between chambers; greatest rates


@dataclass(frozen=True, eq=False)
class ActuatorFit:
    """Calibrated actuators and whether to trust them. Errors are RMS of simulated less measured pressures."""

    spec: ArmSpec  # arm with the actuators that are better on held-out seconds, and a law that suits them
    chosen: str  # which of `held_out_rms_kpa` these actuators are
    half_width_95: Mapping[str, np.ndarray]  # half-widths (c,) of the 95 % intervals of a regulator's numbers
    in_sample_rms_kpa: float  # seconds of the fit
    held_out_rms_kpa: Mapping[str, float]  # held-out seconds: regulator, pump, the specification, the command
    chamber_rms_kpa: np.ndarray  # (c,) held-out seconds of each chamber
    n_tracks: int
    time_s: float
    warnings: tuple[str, ...] = ()  # reasons not to trust the fit, each with its remedy
    notes: tuple[str, ...] = ()  # numbers that the logs do not show


def fit_actuators(tracks: Sequence[Track], spec: ArmSpec, seed: int = 0) -> ActuatorFit:
    """Fit regulators, and the flow of pumps; keep those that are better on held-out seconds.

    Args:
        tracks: parts of logs from `find_tracks`, one or more.
        spec: arm, its chambers already calibrated.
        seed: seed that chooses the held-out seconds.
    """
    runs = Runs(tracks, 1.0 / spec.control.rate_hz)
    held_out = np.repeat(held_out_blocks(runs.n_seconds, BLOCK_S, seed), spec.n_chambers)

    # Fit both kinds; judge them, the specification and the command by the held-out seconds
    regulator, solution = fit_regulator(runs, ~held_out)
    pump = _fit_pump(runs, ~held_out, spec)
    kinds = {"regulator": regulator, "pump": pump, "specification": spec.actuators}
    errors = {name: runs.errors(actuators.per_chamber(spec.n_chambers)) for name, actuators in kinds.items()}
    errors["command"] = runs.clusters([t.commanded_kpa - t.pressure_kpa for t in tracks])
    rms = {name: rms_of(error[held_out]) for name, error in errors.items()}
    bound = {name: max(MARGIN * value, value + SMALL_KPA) for name, value in rms.items()}
    simpler = "specification" if rms["specification"] <= bound["pump"] else "pump"
    chosen = simpler if rms[simpler] <= bound["regulator"] else "regulator"

    # Put the better kind into the specification
    own = held_out.reshape(-1, spec.n_chambers)
    error = errors[chosen].reshape(*own.shape, -1)
    done = ActuatorFit(
        spec=with_actuators(spec, kinds[chosen]),
        chosen=chosen,
        half_width_95=_half_widths(regulator, solution),
        in_sample_rms_kpa=rms_of(errors[chosen][~held_out]),
        held_out_rms_kpa=rms,
        chamber_rms_kpa=np.array([rms_of(error[own[:, k], k]) for k in range(spec.n_chambers)]),
        n_tracks=len(tracks),
        time_s=sum(len(track.pressure_kpa) for track in tracks) / spec.control.rate_hz,
    )
    return dataclasses.replace(done, warnings=_warnings(done, solution), notes=_notes(done))


def with_actuators(spec: ArmSpec, actuators: Actuators) -> ArmSpec:
    """Return the arm with other actuators.

    Behind regulators the law's integral time kp / ki is at least their lag and dead time: a faster integral
    swings. On four rods the springs are then within 0.1 mm after 8 s; with the paper's gains one of the rods
    keeps swinging by 11 mm.
    """
    own = _plain(actuators)
    spec = spec.replace(actuators={"kind": actuators.kind, **own})
    if not isinstance(actuators, Regulator) or spec.control.kp_kpa_per_m == 0.0:
        return spec
    slowest = spec.control.kp_kpa_per_m / float(np.mean(actuators.lag_s) + np.mean(actuators.dead_time_s))
    return spec.replace(control={"ki_kpa_per_ms": min(spec.control.ki_kpa_per_ms, slowest)})


def fit_regulator(runs: Runs, used: np.ndarray) -> tuple[Regulator, Solution]:
    """Fit regulators to the clusters `used` (n,) bool; return them and the solution.

    Parameters are the logarithms of `_SHARED` over the start, offsets (c,) [kPa], and the logarithms of the
    chambers' deviations, `_OWN` by c.
    """
    c = runs.n_chambers
    start = _start(runs, used)

    def regulator(x: np.ndarray) -> Regulator:
        shared, offset, own = x[: len(_SHARED)], x[len(_SHARED) :][:c], x[len(_SHARED) + c :].reshape(-1, c)
        own = np.concatenate([own, np.zeros((len(_SHARED) - len(own), c))])
        values = {name: start[name] * np.exp(shared[k] + own[k]) for k, name in enumerate(_SHARED)}
        values["dead_time_s"] = np.minimum(values["dead_time_s"], LONGEST_DELAY_S)
        return Regulator(**values, offset_kpa=offset)

    def model(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        # A change of a shared number changes all chambers, one of a chamber that chamber alone
        steps = np.eye(len(_SHARED) + 1) * DIFFERENCE
        ahead = [np.r_[step[:-1], np.full(c, step[-1]), np.zeros(len(_OWN) * c)] for step in steps]
        here, *others = runs.errors_of([regulator(x + step) for step in (np.zeros_like(x), *ahead)])
        slope = np.stack([(other - here) / DIFFERENCE for other in others], axis=-1)  # (n, m, shared + 1)
        mask = np.eye(c)[np.arange(len(here)) % c][:, None]  # (n, 1, c): a cluster belongs to a chamber
        columns = [slope[..., :-1], slope[..., -1:] * mask]
        columns += [slope[..., k : k + 1] * mask for k in range(len(_OWN))]
        return here[used], np.concatenate(columns, axis=-1)[used]

    priors = [SHARED_PRIOR] * len(_SHARED) + [OFFSET_PRIOR_KPA] * c + [CHAMBER_PRIOR] * len(_OWN) * c
    solution = _fit(model, np.array(priors), runs.rows)
    return regulator(solution.x), solution


def _fit_pump(runs: Runs, used: np.ndarray, spec: ArmSpec) -> Pump:
    """Fit the flow of pumps whose valves are those of the specification, or of the paper."""
    own = spec.actuators if isinstance(spec.actuators, Pump) else PAPER_PUMP

    def pump(x: np.ndarray) -> Pump:
        return dataclasses.replace(own, flow_l_per_min=float(own.flow_l_per_min * np.exp(x[0])))

    def model(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        here, ahead = (runs.errors(pump(x + step)) for step in (0.0, DIFFERENCE))
        return here[used], ((ahead - here) / DIFFERENCE)[used, :, None]

    return pump(_fit(model, np.array([SHARED_PRIOR]), runs.rows).x)


def _fit(model: Model, prior: np.ndarray, rows: int) -> Solution:
    """Minimise the squared errors (n, rows) of a model from x = 0.

    Rows at rest are many and exact; a robust loss would take the transients among them for outliers. The rows
    of a cluster are not independent: together they weigh as one.
    """
    scale = np.array([SCALE_KPA * rows**0.5])
    problem = Problem(prior, np.zeros(rows, int), scale, min_scale=scale, huber=NO_OUTLIERS)
    x = descend(model, np.zeros(len(prior)), scale, problem, "linear", TOLERANCES)
    return solution_at(x, *model(x), problem)


def _start(runs: Runs, used: np.ndarray) -> dict[str, np.ndarray]:
    """Return numbers (c,) of regulators, alike for all chambers: the best of a grid.

    Of rates that fit alike the greatest are taken: commands that changed slowly do not show a limit.
    """
    range_kpa = max(np.ptp(track.commanded_kpa) for track in runs.tracks)
    c, offset = runs.n_chambers, runs.rest_offset_kpa()
    grid = [
        {"lag_s": lag, "dead_time_s": dead, "fill_kpa_per_s": fill, "vent_kpa_per_s": vent}
        for lag, dead in itertools.product(LAGS_S, DEAD_TIMES_S)
        for fill, vent in itertools.product(range_kpa * np.array(RATES), repeat=2)
    ]
    grid = [{**numbers, "deadband_kpa": DEADBAND_KPA} for numbers in grid]
    starts = [{name: np.full(c, value) for name, value in numbers.items()} for numbers in grid]
    errors = runs.errors_of([Regulator(**numbers, offset_kpa=offset) for numbers in starts])
    rms = np.array([rms_of(error[used]) for error in errors])
    return starts[int(np.argmax(rms <= ALIKE * rms.min()))]


def _plain(actuators: Actuators) -> dict[str, float | tuple[float, ...]]:
    """Return the numbers of actuators as a specification has them."""
    values = dataclasses.asdict(actuators)
    return {name: tuple(map(float, x)) if np.ndim(x) else float(x) for name, x in values.items()}


def _half_widths(regulator: Regulator, solution: Solution) -> dict[str, np.ndarray]:
    """Return the half-widths (c,) of the numbers of a regulator, of shared and own parameters together."""
    c, n = np.size(regulator.offset_kpa), len(_SHARED)
    covariance = solution.covariance
    widths = {}
    for k, name in enumerate(_SHARED):
        variance = np.full(c, covariance[k, k])
        if name in _OWN:
            own = n + c + k * c + np.arange(c)
            variance = variance + covariance[own, own] + 2 * covariance[k, own]
        widths[name] = QUANTILE * np.sqrt(np.maximum(variance, 0.0)) * getattr(regulator, name)
    offset = n + np.arange(c)
    return widths | {"offset_kpa": QUANTILE * np.sqrt(covariance[offset, offset])}


def _warnings(done: ActuatorFit, solution: Solution) -> tuple[str, ...]:
    said = [] if solution.converged else [NOT_CONVERGED]
    said += [
        f"{name} is known to {100 * share:.0f} % only: log larger steps of the commands"
        for name, share in _uncertain(done).items()
        if name not in _RATES
    ]
    held_out = done.held_out_rms_kpa[done.chosen]
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
