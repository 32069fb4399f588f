"""Result codes of the simulation: why settling or a motion ended, each with a text for messages."""

from __future__ import annotations

import enum


class Result(enum.IntEnum):
    """A code that arrays hold, with a text that completes "the arm does not settle: ..."."""

    text: str

    def __new__(cls, code: int, text: str) -> Result:
        member = int.__new__(cls, code)
        member._value_ = code
        member.text = text
        return member


class SettleResult(Result):
    """Ends of `mjx_softarm.mechanics.settle.settle`."""

    CONVERGED = 0, "forces balance, and every spring is at its reference or its chamber at a limit"
    OUT_OF_ITERATIONS = (
        1,
        "forces or springs are still off by more than the tolerance after the last iteration",
    )
    NOT_CONVEX = 2, "its energy is not convex there, so it buckles, or its springs do not follow its chambers"
    NOT_FINITE = 3, "a force or a length is not a finite number"


class MotionResult(Result):
    """Ends of `mjx_softarm.mechanics.dynamics.advance`."""

    FINITE = 0, "every joint coordinate and velocity is finite"
    NOT_FINITE = 1, "a joint coordinate or velocity is not a finite number"
