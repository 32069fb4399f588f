"""Motion capture systems: the option that names one, its frames, and checks of names."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from mjx_softarm._support.errors import InputError

# From the system's axes to ours, whose z points up.
UP = {"y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]), "z": np.eye(3)}
_DEFAULT_UP = {"natnet": "y", "qualisys": "z"}


class CaptureFrame(NamedTuple):
    """A frame in the axes of its system.

    Attributes:
        time_s: time [s] on the system's clock.
        bodies: origin (3,) [m] and axes (3, 3), as columns, of each rigid body that is seen.
        marker_m (n_markers, 3) [m]: NaN for a marker that is not seen.
    """

    time_s: float
    bodies: Mapping[str, tuple[np.ndarray, np.ndarray]]
    marker_m: np.ndarray


class CaptureName(NamedTuple):
    """Settings that the option `--capture` names."""

    system: str
    host: str
    body: str
    base: str = ""
    markers: str = ""
    up: str = ""

    @classmethod
    def read(cls, text: str) -> CaptureName:
        """Read the option's text; InputError if it is malformed."""
        words, *options = text.split(",")
        system, host, body, *_ = *words.split(":", 2), "", ""
        named = {key: value for key, _, value in (option.partition("=") for option in options)}
        named_well = named.keys() <= {"base", "markers", "up"} and all(named.values())
        if system not in _DEFAULT_UP or not host or not body or not named_well:
            expected = "natnet:HOST:BODY or qualisys:HOST:BODY, maybe with ,base=BODY,markers=NAME,up=y|z"
            raise InputError(f"--capture: got {text!r}, expected {expected}")
        name = cls(system, host, body, **{"up": _DEFAULT_UP[system]} | named)
        if name.up not in UP:
            raise InputError(f"--capture: got up={name.up}, expected y or z")
        return name


def check_names(where: str, kind: str, asked: str, known: list[str]) -> None:
    """Refuse a body or a marker set, by an InputError, that the system does not have."""
    if asked and asked not in known:
        raise InputError(f"{where}: got no {kind} {asked!r}, expected one of {', '.join(known) or 'some'}")


def numbered(prefix: str, labels: list[str]) -> list[int]:
    """Return the places of the labels PREFIX0, PREFIX1, ..., in the order of their numbers."""
    places = {
        int(label[len(prefix) :]): k
        for k, label in enumerate(labels)
        if re.fullmatch(re.escape(prefix) + r"\d+", label)
    }
    return [places[number] for number in sorted(places)]
