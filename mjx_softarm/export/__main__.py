"""Command line: `python -m mjx_softarm.export check`."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import tyro

from mjx_softarm._support import cli
from mjx_softarm._support.errors import InputError
from mjx_softarm.export.check import check
from mjx_softarm.export.golden import read_golden

_DIFFERENT = 1  # exit status


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit status."""
    about = "Policies beyond Python. Exit status: 0 all agree, 1 some differ, 2 one could not be checked."
    return cli.main("python -m mjx_softarm.export", about, {"check": _check}, arguments)


def _check(golden: tyro.conf.Positional[Path], runtimes: tyro.conf.Positional[tuple[Path, ...]]) -> int:
    """Compare the answers of policy files, graphs and programs with golden rows.

    Args:
        golden: golden rows, policy_golden.csv of `--onnx` or golden.csv of `--cpp`
        runtimes: policy.npz, policy.onnx, or a program that reads rows from its input and writes the outputs
    """
    if not runtimes:
        raise InputError("RUNTIMES: got none, expected policy.npz, policy.onnx or a program")
    rows, status = read_golden(golden), 0
    for path in runtimes:
        agreement = check(rows, path)
        print(f"{path}: {agreement}")
        status = status if agreement.holds else _DIFFERENT
    return status


if __name__ == "__main__":
    sys.exit(main())
