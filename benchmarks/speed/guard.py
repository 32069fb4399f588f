"""Whether something got slower: a small fixed benchmark against a stored one of the same kind of machine.

    python -m benchmarks guard            compare; for use before a release, in about four minutes
    python -m benchmarks guard --store    make this the baseline of this kind of machine

Exit status 0 if nothing is worse, 1 if something is, 2 if there is no baseline, or none worth storing, or if
a measurement failed. What is measured stands in `benchmarks.speed.guard_work`. A cost is the least time of some
work over the least of its reference in a process, since what disturbs only adds. Processes run one after the
other, since what differs from one to the next, such as where memory lies, is a part of the spread. A
comparison takes the median of three. Tolerance is twice the furthest that a median of three of the baseline's
five lies from the median of all, and at least a tenth, since the spread of an hour is not that of a month; a
baseline with one above a quarter is refused, since it would let through what it is there to stop.
"""

from __future__ import annotations

import argparse
import itertools
import json
import platform
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from benchmarks.harness.common import RESULTS, n_cores, show
from benchmarks.harness.rounds import Facts, Worker, WorkerError, working
from benchmarks.speed.guard_work import ON_DEVICE, ON_HOST, reference_of, work_here
from mjx_softarm._support.provenance import provenance, write_json

FILE = RESULTS / "guard.json"
N_PROCESSES, N_STORED = 3, 5  # of a comparison, of a baseline
N_ROUNDS = 12
MARGIN = 2.0
LEAST_TOLERANCE, MOST_TOLERANCE = 0.1, 0.25  # the latter of a baseline that is worth comparing with
WORSE, NO_RESULT = 1, 2

MEASURED = (*ON_DEVICE, *ON_HOST)

Samples = Mapping[str, Sequence[Facts]]  # cost and seconds of each process, by what was measured


class BaselineError(ValueError):
    """There is nothing to compare with; the message says why."""


def main(arguments: Sequence[str]) -> int:
    """Compare or store; returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks guard",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--store", action="store_true", help="make this the baseline of this kind of machine")
    options = parser.parse_args(arguments)
    kind, sizes = machine_kind(), {"n_rounds": N_ROUNDS, **work_here()}
    try:
        return _store(kind, sizes) if options.store else _compare(kind, sizes)
    except BaselineError as error:
        print(f"{error}; store one, on a state that is known to be good: python -m benchmarks guard --store")
    except WorkerError as error:
        print(f"error: {error.reason}")
    return NO_RESULT


def _store(kind: str, sizes: Mapping[str, int]) -> int:
    costs = baseline_of(measure(N_STORED))
    show({"costs": _stored_rows(costs)}, f"baseline of {kind}")
    if loose := [name for name, stored in costs.items() if stored["tolerance"] > MOST_TOLERANCE]:
        print(
            f"not stored: the tolerance of {', '.join(loose)} is above {100 * MOST_TOLERANCE:.0f} %, its "
            "processes lie too far apart; try again while nothing else runs on this machine"
        )
        return NO_RESULT
    store(FILE, kind, {"costs": costs, "sizes": sizes, **provenance("benchmarks")})
    print(f"written: {FILE}")
    return 0


def _compare(kind: str, sizes: Mapping[str, int]) -> int:
    baseline = read_baseline(FILE, kind, sizes)
    rows = compare(baseline["costs"], measure(N_PROCESSES))
    show({"costs": rows}, f"guard, {kind}, baseline of commit {baseline['commit']}")
    worse = [row["work"] for row in rows if row["verdict"] == "WORSE"]
    print(f"worse: {', '.join(worse)}" if worse else "nothing is worse")
    return WORSE if worse else 0


def machine_kind() -> str:
    """What baselines are kept by: the GPU's name, or the CPU's and the number of its cores."""
    if jax.default_backend() == "gpu":
        return jax.devices()[0].device_kind
    info = Path("/proc/cpuinfo")
    found = re.search(r"model name\s*: (.+)", info.read_text("utf-8")) if info.exists() else None
    name = found[1].strip() if found else platform.processor() or platform.machine()
    return f"{name}, {n_cores()} cores"


def measure(n_processes: int) -> Samples:
    """Costs of each process, by what was measured."""
    on_gpu = jax.default_backend() == "gpu"
    samples: dict[str, list[Facts]] = {name: [] for name in MEASURED}
    for k in range(n_processes):
        print(f"process {k + 1} of {n_processes}: compiling, then {N_ROUNDS} rounds", flush=True)
        worker = Worker("guard", ["benchmarks.speed.guard_work"], n_cores=None if on_gpu else 1)
        with working(worker):
            costs = costs_of([worker.facts | worker.round() for _ in range(N_ROUNDS)])
        for name, own in samples.items():
            own.append(costs[name])
    return samples


def costs_of(rounds: Sequence[Mapping[str, float]]) -> dict[str, Facts]:
    """A process's costs, and the seconds that the work took at least, by what was measured.

    Args:
        rounds: seconds of each, by name, with those of the references.
    """
    least = {name: min(seconds[name] for seconds in rounds) for name in rounds[0]}
    return {
        name: {"cost": least[name] / least[reference_of(name)], "seconds": least[name]} for name in MEASURED
    }


def baseline_of(samples: Samples) -> dict[str, dict[str, Any]]:
    """Median cost, tolerance and the processes' costs, by what was measured."""
    baseline = {}
    for name, own in samples.items():
        costs = [facts["cost"] for facts in own]
        compared = np.median(list(itertools.combinations(costs, N_PROCESSES)), axis=1)
        cost = float(np.median(costs))
        spread = float(np.max(np.abs(compared / cost - 1.0)))
        tolerance = max(LEAST_TOLERANCE, MARGIN * spread)
        baseline[name] = {"cost": cost, "tolerance": tolerance, "processes": costs}
    return baseline


def compare(baseline: Mapping[str, Mapping[str, Any]], samples: Samples) -> list[dict[str, Any]]:
    """A row for each cost: baseline, now, change, the spread of now's processes, and what to think of it."""
    rows = []
    for name, stored in baseline.items():
        costs = [facts["cost"] for facts in samples[name]]
        now, tolerance = float(np.median(costs)), stored["tolerance"]
        change = now / stored["cost"] - 1.0
        verdict = "WORSE" if change > tolerance else "better" if change < -tolerance else "same"
        rows.append(
            {
                "work": name,
                "baseline": stored["cost"],
                "now": now,
                "change": f"{100 * change:+.1f} %",
                "tolerance": f"{100 * tolerance:.1f} %",
                "spread": f"{100 * (max(costs) - min(costs)) / now:.1f} %",
                "seconds": float(np.median([facts["seconds"] for facts in samples[name]])),
                "verdict": verdict,
            }
        )
    return rows


def _stored_rows(costs: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    return [
        {
            "work": name,
            "cost": stored["cost"],
            "tolerance": f"{100 * stored['tolerance']:.1f} %",
        }
        for name, stored in costs.items()
    ]


def store(file: Path, kind: str, baseline: Mapping[str, Any]) -> None:
    """Write a baseline; those of other kinds of machines stay."""
    write_json(file, {"kinds": {**_kinds(file), kind: dict(baseline)}})


def read_baseline(file: Path, kind: str, sizes: Mapping[str, int]) -> dict[str, Any]:
    """The baseline of a kind of machine.

    Args:
        file: of all baselines.
        kind: of machine.
        sizes: of the work that is to be compared.

    Raises:
        BaselineError: there is none, or of other work.
    """
    kinds = _kinds(file)
    if kind not in kinds:
        known = ", ".join(kinds) or "none"
        raise BaselineError(f"{file}: no baseline for {kind}; it has: {known}")
    baseline = kinds[kind]
    if baseline["sizes"] != dict(sizes) or baseline["costs"].keys() != set(MEASURED):
        raise BaselineError(f"{file}: the baseline for {kind} is of other work than what is measured now")
    return baseline


def _kinds(file: Path) -> dict[str, Any]:
    return json.loads(file.read_text("utf-8"))["kinds"] if file.exists() else {}
