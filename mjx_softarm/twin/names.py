"""Twins by name."""

from __future__ import annotations

from pathlib import Path

from mjx_softarm.mechanics.pipe import PIPES_MM, CrossPipe
from mjx_softarm.spec import ArmSpec
from mjx_softarm.twin.arm import Twin
from mjx_softarm.twin.rod_twin import RodTwin

ROD = "rod"


def twin_of(name: str) -> Twin | RodTwin:
    """Make the twin of a name: `SEED`, `SEED:PIPE`, `rod:SEED`, `rod:SEED@ARM`; with a payload `SEED:500g`.

    Rods can be of any arm, named as for `--spec`; other twins are of the paper's arm.

    Raises:
        ValueError: the name is malformed, the arm is unknown, or the arm does not fit into the pipe.
    """
    name, payload_kg = _without_payload(name)
    if name.startswith(f"{ROD}:"):
        seed, at, arm = name.removeprefix(f"{ROD}:").partition("@")
        number = _seed(seed, f"twin:{ROD}:SEED")
        return RodTwin(number, ArmSpec.of(Path(arm)) if at else None, payload_kg)
    seed, colon, pipe = name.partition(":")
    number = _seed(seed, "twin:SEED")
    if colon and pipe not in PIPES_MM:
        raise ValueError(f"twin:{seed}:PIPE: got {pipe!r}, expected {' or '.join(PIPES_MM)}, or grams, 500g")
    return Twin(number, payload_kg=payload_kg, pipe=CrossPipe.of_mm(PIPES_MM[pipe]) if pipe else None)


def _without_payload(name: str) -> tuple[str, float]:
    """Return the name without its payload, and the payload [kg]."""
    rest, _, last = name.rpartition(":")
    grams = last.removesuffix("g")
    return (rest, 1e-3 * int(grams)) if rest and last != grams and grams.isdecimal() else (name, 0.0)


def _seed(text: str, form: str) -> int:
    if not text.isdecimal():
        raise ValueError(f"{form}: got {text!r}, expected an integer >= 0")
    return int(text)
