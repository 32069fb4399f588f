"""Twins by name."""

from __future__ import annotations

import re
from pathlib import Path

from mjx_softarm.mechanics.pipe import PIPES
from mjx_softarm.spec import ArmSpec
from mjx_softarm.twin.arm import Twin
from mjx_softarm.twin.instruments import AGED, AS_BUILT, EXACT
from mjx_softarm.twin.rod_twin import RodTwin

ROD = "rod"
_BUILDS = {None: AS_BUILT, "aged": AGED, "exact": EXACT}
_NAME = re.compile(r"(.*?)(?::(aged|exact))?(?::lost(\d+))?(?::(\d+)g)?", re.DOTALL)


def twin_of(name: str) -> Twin | RodTwin:
    """Make the twin of a name: `SEED` or `rod:SEED`, maybe with more.

    More is, in this order, `@ARM`, `:PIPE`, `:aged` or `:exact`, `:lost4`, `:500g`. The arm is named as for
    `--spec`, by default the paper's. A payload is given in grams. Rods have no pipe.

    Raises:
        ValueError: the name is malformed, the arm is unknown, or the arm does not fit into the pipe.
    """
    match = _NAME.fullmatch(name)
    assert match  # the first group takes everything
    name, build, lost, grams = match.groups()
    build = _BUILDS[build]._replace(lost=None if lost is None else int(lost))
    payload_kg = 1e-3 * int(grams or 0)
    if name.startswith(f"{ROD}:"):
        number, spec = _seed_and_arm(name.removeprefix(f"{ROD}:"), f"twin:{ROD}:SEED")
        return RodTwin(number, spec, payload_kg, build=build)
    rest, colon, pipe = name.partition(":")
    number, spec = _seed_and_arm(rest, "twin:SEED")
    if colon and pipe not in PIPES:
        raise ValueError(
            f"twin:{rest}: got {pipe!r}, expected one of {', '.join(PIPES)}, then aged or exact, then a "
            "lost chamber, lost4, then grams, 500g; each may be left out"
        )
    return Twin(number, spec, payload_kg, build=build, pipe=PIPES[pipe] if pipe else None)


def _seed_and_arm(text: str, form: str) -> tuple[int, ArmSpec | None]:
    """Return seed and arm of `SEED` or `SEED@ARM`; None is the paper's arm."""
    seed, at, arm = text.partition("@")
    if not seed.isdecimal():
        raise ValueError(f"{form}: got {seed!r}, expected an integer >= 0")
    if at and not arm:
        raise ValueError(f"{form}@ARM: got no arm, expected one as for --spec")
    return int(seed), ArmSpec.of(Path(arm)) if at else None
