"""What options of several benchmarks have in common."""

from __future__ import annotations

import argparse


def numbers(text: str) -> tuple[int, ...]:
    """Different numbers in rising order, of a text such as `0,1,2`."""
    parts = text.split(",")
    if not all(part.isdecimal() for part in parts):
        raise argparse.ArgumentTypeError(f"got {text!r}, expected integers >= 0 with commas between them")
    return tuple(sorted({int(part) for part in parts}))
