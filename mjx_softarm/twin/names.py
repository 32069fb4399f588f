"""Twins by name."""

from __future__ import annotations

from mjx_softarm.mechanics.pipe import PIPES_MM, CrossPipe
from mjx_softarm.twin.arm import Twin
from mjx_softarm.twin.rod_twin import RodTwin

ROD = "rod"


def twin_of(name: str) -> Twin | RodTwin:
    """Make the twin of a name, `SEED`, `SEED:PIPE` or `rod:SEED`, each with a payload as `SEED:500g`.

    Raises:
        ValueError: the name is malformed, or the arm of this seed does not fit into the pipe.
    """
    name, payload_kg = _without_payload(name)
    if name.startswith(f"{ROD}:"):
        return RodTwin(_seed(name.removeprefix(f"{ROD}:"), f"twin:{ROD}:SEED"), payload_kg=payload_kg)
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
