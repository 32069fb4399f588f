"""Twins by name."""

from __future__ import annotations

from pathlib import Path

from mjx_softarm.mechanics.pipe import PIPES
from mjx_softarm.spec import ArmSpec
from mjx_softarm.twin.arm import Twin
from mjx_softarm.twin.instruments import AGED, AS_BUILT, EXACT
from mjx_softarm.twin.rod_twin import RodTwin

ROD = "rod"
_BUILDS = {":aged": AGED, ":exact": EXACT}


def twin_of(name: str) -> Twin | RodTwin:
    """Make the twin of a name: `SEED` or `rod:SEED`, maybe with more.

    More is, in this order, `@ARM`, `:PIPE`, `:aged` or `:exact`, `:lost4`, `:500g`. The arm is named as for
    `--spec`, by default the paper's. A payload is given in grams. Rods have no pipe.

    Raises:
        ValueError: the name is malformed, the arm is unknown, or the arm does not fit into the pipe.
    """
    name, payload_kg = _without_payload(name)
    rest, _, last = name.rpartition(":lost")
    name, lost = (rest, int(last)) if rest and last.isdecimal() else (name, None)
    suffix = next(filter(name.endswith, _BUILDS), "")
    build = _BUILDS.get(suffix, AS_BUILT)._replace(lost=lost)
    name = name.removesuffix(suffix)
    if name.startswith(f"{ROD}:"):
        number, spec = _seed_and_arm(name.removeprefix(f"{ROD}:"), f"twin:{ROD}:SEED")
        return RodTwin(number, spec, payload_kg, build=build)
    rest, colon, pipe = name.partition(":")
    number, spec = _seed_and_arm(rest, "twin:SEED")
    if colon and pipe not in PIPES:
        raise ValueError(
            f"twin:{rest}:PIPE: got {pipe!r}, expected one of {', '.join(PIPES)}, or grams, 500g"
        )
    return Twin(number, spec, payload_kg, build=build, pipe=PIPES[pipe] if pipe else None)


def _without_payload(name: str) -> tuple[str, float]:
    """Return the name without its payload, and the payload [kg]."""
    rest, _, last = name.rpartition(":")
    grams = last.removesuffix("g")
    return (rest, 1e-3 * int(grams)) if rest and last != grams and grams.isdecimal() else (name, 0.0)


def _seed_and_arm(text: str, form: str) -> tuple[int, ArmSpec | None]:
    """Return seed and arm of `SEED` or `SEED@ARM`; None is the paper's arm."""
    seed, at, arm = text.partition("@")
    if not seed.isdecimal():
        raise ValueError(f"{form}: got {seed!r}, expected an integer >= 0")
    if at and not arm:
        raise ValueError(f"{form}@ARM: got no arm, expected one as for --spec")
    return int(seed), ArmSpec.of(Path(arm)) if at else None
