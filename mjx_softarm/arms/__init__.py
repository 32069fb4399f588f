"""Arms that the package describes, each a TOML file with its sources."""

from __future__ import annotations

from importlib import resources

from mjx_softarm._support.fields import SpecError


def shipped_arm(name: str) -> str:
    """Return the TOML of an arm that the package describes.

    Raises:
        SpecError: there is no arm of this name; the message lists the arms.
    """
    files = {file.name: file for file in resources.files(__name__).iterdir()}
    arms = {name.removesuffix(".toml"): file for name, file in files.items() if name.endswith(".toml")}
    if name not in arms:
        raise SpecError(f"{name}: got no such arm, expected a file, or {', '.join(sorted(arms))}")
    return arms[name].read_text("utf-8")
