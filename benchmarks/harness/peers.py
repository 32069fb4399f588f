"""Virtual environments `.venv-PEER` of the libraries that this project is compared with, made on first use.

Each has the peer, and the simulator's packages in the versions that run here. A file in each lists its
packages: an incomplete environment, or one of other packages, is made anew.

On Linux, PyTorch comes with gigabytes of CUDA. To do without them, set
`PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu`.
"""

from __future__ import annotations

import subprocess
import sys
import venv
from importlib import metadata
from pathlib import Path

from benchmarks.harness.rounds import ROOT
from mjx_softarm._support.errors import InputError

MARKER = "complete"

_SB3 = ("stable-baselines3==2.9.2", "torch==2.13.0")
PINS = {
    "sbx": ("sbx-rl==0.28.0", *_SB3),
    "sb3-contrib": ("sb3-contrib==2.9.2", *_SB3),
    "soromox": ("soromox==0.5.0", "diffrax==0.7.2", "equinox==0.13.8"),
}
# Packages of mjx_softarm and of its extra `sim`, and those that evaluation and `train.epoch.job` import, too.
SHARED = (
    *("numpy", "tomli_w", "tyro"),
    *("jax", "jaxlib", "mujoco", "mujoco-mjx", "brax", "gymnasium", "matplotlib", "pillow", "scipy"),
    *("flax", "optax"),
)


def peer_python(name: str, root: Path = ROOT) -> Path:
    """Return the interpreter of the virtual environment of a peer, a key of `PINS`; make it if it is missing.

    Raises:
        InputError: it could not be made.
    """
    home, packages = root / f".venv-{name}", peer_packages(name)
    python, marker = home / "bin" / "python", home / MARKER
    content = "\n".join([f"python {sys.version_info.major}.{sys.version_info.minor}", *packages]) + "\n"
    if marker.exists() and marker.read_text("utf-8") == content:
        return python
    print(f"making {home} with {packages[0]}; the first time this takes minutes ...", flush=True)
    marker.unlink(missing_ok=True)
    try:
        venv.create(home, with_pip=True, clear=True)
        install = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *packages]
        subprocess.run(install, check=True, capture_output=True, text=True)
    except (OSError, subprocess.CalledProcessError) as error:
        output = (getattr(error, "stderr", None) or str(error)).strip().splitlines()
        expected = f"expected a virtual environment in {home}"
        raise InputError(f"{name}: got {output[-1] if output else error}, {expected}") from error
    marker.write_text(content, "utf-8")
    return python


def peer_packages(name: str) -> tuple[str, ...]:
    """Return the packages of a peer's environment; its JAX is for CUDA if this one is."""
    versions = dict(pin.split("==") for pin in PINS[name])
    versions |= {package: metadata.version(package) for package in SHARED}
    if "jax-cuda12-plugin" in {distribution.name for distribution in metadata.distributions()}:
        versions["jax[cuda12]"] = versions.pop("jax")
    return tuple(f"{package}=={version}" for package, version in versions.items())
