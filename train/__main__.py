"""Command line: `python -m train COMMAND`."""

from __future__ import annotations

import os

# XLA logs a page for every program that it takes from the cache.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import sys
from collections.abc import Sequence

from mjx_softarm._support import cli

COMMANDS = {
    "reach": ("train.runs.command:Reach", "train a policy that reaches poses of the workspace"),
    "imitate": ("train.runs.command:Imitate", "train a policy that reaches poses as they were shown"),
    "evaluate": ("train.runs.command:evaluate", "evaluate a run's newest policy, with figures and pictures"),
    "export": ("train.runs.command:export", "write policies, each as one npz file"),
    "sweep": (
        "train.sweep.command:SweepCommand",
        "train `reach` with several seeds and settings, all at once",
    ),
    "demos record": ("train.demos.command:Record", "bring an arm's finger tips to poses, and log them"),
    "demos check": ("train.demos.command:Check", "tell what a file of demonstrations has, and what is wrong"),
}
_SHORT = {"--engine": "--env.engine", "--mode": "--env.mode", "--pipe": "--env.pipe-diameter-mm"}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit status."""
    words = in_full(sys.argv[1:] if arguments is None else arguments)
    return cli.main("python -m train", "Train, evaluate and export policies.", COMMANDS, words)


def in_full(words: Sequence[str]) -> list[str]:
    """Return the words of a command line with short names of options replaced by their full names."""
    parts = [word.partition("=") for word in words]
    return [_SHORT.get(name, name) + equals + value for name, equals, value in parts]


if __name__ == "__main__":
    sys.exit(main())
