"""Provenance of a result: versions, machine and commit; and JSON files."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

import jax

from mjx_softarm._support.files import replacing

PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "flax", "optax", "orbax-checkpoint", "numpy")


def provenance(program: str) -> dict[str, Any]:
    """Return versions, machine and commit; changed files in docs/results do not count as uncommitted."""
    commit = status = None
    # An installed package has no commit, not even where it lies within somebody's repository.
    if _git("ls-files", "--error-unmatch", Path(__file__).name) is not None:
        commit = _git("rev-parse", "HEAD")
        status = _git("status", "--porcelain", "--", ":/", ":(top,exclude)docs/results")
    versions = {}
    for name in PACKAGES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = "absent"
    return {
        "python": platform.python_version(),
        "packages": versions,
        "machine": {"platform": platform.platform(), "cpus": os.cpu_count(), "device": str(jax.devices()[0])},
        "command": " ".join(["python", "-m", program, *sys.argv[1:]]),
        "commit": commit,
        "uncommitted_changes": None if status is None else bool(status),
    }


def _git(*arguments: str) -> str | None:
    here = Path(__file__).resolve().parent
    try:
        done = subprocess.run(["git", *arguments], cwd=here, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip()


def write_json(path: Path, data: Any) -> None:
    """Write a JSON file whole or not at all."""
    with replacing(path) as part:
        part.write_text(json.dumps(data, indent=2) + "\n", "utf-8")
