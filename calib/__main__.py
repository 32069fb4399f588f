"""Command line: `python -m calib template | check | demo | run`."""

from __future__ import annotations

import os

# XLA logs a page for every program that it takes from the cache.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import argparse
import sys
from pathlib import Path

from calib.errors import FitError
from mjx_softarm._support.archive import SealedFileError
from mjx_softarm.logs.checks import Finding, LogError
from mjx_softarm.logs.schema import Log
from mjx_softarm.spec import ArmSpec, SpecError


def main(arguments: list[str] | None = None) -> int:
    """Run a command; returns the exit status: 0 done, 1 not to be trusted, 2 not done, 130 interrupted."""
    options = _parser().parse_args(arguments)
    try:
        return options.command(options)
    except (LogError, FitError, SpecError, SealedFileError, FileExistsError) as error:
        print(f"error: {error}", file=sys.stderr)
    except OSError as error:
        print(f"error: {error.filename}: {error.strerror}", file=sys.stderr)
    except KeyboardInterrupt:
        return 130
    return 2


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m calib", description="Calibrate an arm from its logs.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    template = commands.add_parser("template", help="write a small log to start from, and say what is in it")
    template.add_argument("out", type=Path, nargs="?", default=Path("log.csv"), help="default: log.csv")
    template.set_defaults(command=_template)
    check = commands.add_parser("check", help="say what is wrong with logs")
    _add_logs(check)
    check.set_defaults(command=_check)
    demo = commands.add_parser("demo", help="write logs of a planted arm, to try everything without hardware")
    demo.add_argument("--out", type=Path, default=Path("calib-demo"), help="folder; default: calib-demo")
    demo.add_argument("--seed", type=_seed, default=0, help="of the arm and the noise; default: 0")
    demo.set_defaults(command=_demo)
    run = commands.add_parser("run", help="calibrate springs, chambers, damping and the sim-to-real network")
    _add_logs(run)
    run.add_argument("--out", type=Path, default=Path("calibration"), help="folder; default: calibration")
    run.add_argument("--shared-springs", action="store_true", help="one beta and delta for all springs")
    run.add_argument(
        "--fit-compensation", action="store_true", help="fit the circuit's compensation inductance, too"
    )
    run.add_argument("--seed", type=_seed, default=0, help="of all that is drawn; default: 0")
    run.set_defaults(command=_run)
    return parser


def _seed(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"got {text!r}, expected a whole number from 0")
    return int(text)


def _add_logs(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("logs", type=Path, nargs="+", metavar="LOG", help="CSV or npz; see `template`")
    parser.add_argument("--spec", type=Path, help="TOML file of the arm so far; default: the paper's arm")
    parser.add_argument(
        "--strict", action="store_true", help="refuse logs with any fault; default: drop rows"
    )


def _template(options: argparse.Namespace) -> int:
    from calib.read.logs import template

    print(template(options.out))
    return 0


def _check(options: argparse.Namespace) -> int:
    logs, findings = _read(options, _spec(options))
    for log in logs:
        print(f"{log.source}: {len(log)} rows to use, {log.time_s[-1] - log.time_s[0]:.1f} s")
    return 1 if findings else 0


def _demo(options: argparse.Namespace) -> int:
    from calib.demo import write_demo
    from mjx_softarm._support import xla

    xla.enable_compilation_cache()
    print("simulating ...", flush=True)
    files = write_demo(options.out, ArmSpec.default(), options.seed)
    print("\n".join(f"log: {file}" for file in files))
    print(f"next: python -m calib run {' '.join(map(str, files))}")
    return 0


def _run(options: argparse.Namespace) -> int:
    from calib.run import calibrate, refuse_existing, write_calibration
    from mjx_softarm._support import xla
    from mjx_softarm._support.provenance import provenance

    refuse_existing(options.out)
    spec = _spec(options)
    logs, findings = _read(options, spec)
    xla.enable_compilation_cache()
    springs = {"shared": options.shared_springs, "fit_compensation": options.fit_compensation}
    calibration = calibrate(logs, spec, options.seed, springs, lambda text: print(text, flush=True))
    write_calibration(options.out, calibration, [str(finding) for finding in findings], provenance("calib"))
    for section in calibration.sections:
        for warning in section.warnings:
            print(f"warning: {section.title}: {warning}")
    print(f"report: {options.out / 'report.html'}")
    print(f"next: python -m train reach --calibration {options.out}")
    return 1 if any(section.warnings for section in calibration.sections) else 0


def _spec(options: argparse.Namespace) -> ArmSpec:
    return ArmSpec.from_toml(options.spec) if options.spec else ArmSpec.default()


def _read(options: argparse.Namespace, spec: ArmSpec) -> tuple[list[Log], list[Finding]]:
    """The logs; what was found is printed."""
    from calib.read.logs import read_log

    logs, findings = [], []
    for path in options.logs:
        log, found = read_log(path, spec.n_chambers, options.strict)
        logs.append(log)
        findings += found
        for finding in found:
            print(finding)
    return logs, findings


if __name__ == "__main__":
    sys.exit(main())
