"""Codes of how a simulation ended, for the equilibrium and for motion."""

from __future__ import annotations

import enum


class Result(enum.IntEnum):
    """A code of how a simulation ended, an int32 in arrays, with a text for messages."""

    text: str

    def __new__(cls, code: int, text: str) -> Result:
        member = int.__new__(cls, code)
        member._value_ = code
        member.text = text
        return member
