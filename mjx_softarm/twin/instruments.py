"""Noisy instruments and checks of commands that all kinds of twins share."""

from __future__ import annotations

import abc
import dataclasses
from typing import Any, NamedTuple

import numpy as np

from mjx_softarm.deploy.arm_io import Capture
from mjx_softarm.pneumatics import Pneumatics
from mjx_softarm.sensing.pose import quaternion_from_rotation, rotation_about
from mjx_softarm.sensing.sensors import Sensor
from mjx_softarm.spec import ArmSpec

# Data for a sim-to-real network and for its evaluation come from the same twin, but from different sessions:
# with other noise and other motions.
S2R_SESSION, EVALUATION_SESSION = 0, 1

PRESSURE_NOISE_KPA = 0.05
CAPTURE_NOISE_M = 2e-4
CAPTURE_NOISE_DEG = 0.1
SPRING_NOISE_M = 2**0.5 * CAPTURE_NOISE_M  # noise of the distance between two markers
PRESSURE_TOLERANCE_KPA = 1e-3  # tolerance beyond the limits, for rounding to float32
MARKERS_PER_SECTION = 3
WIDEST_DRAW = 2.0  # largest deviation of a part, in standard deviations; a worse part is not mounted
GAP = 1.9  # scale of the tolerances; the modules of the twins say how it was set


class Build(NamedTuple):
    """Scales of a twin's deviations from an ideal arm; tests set some of them to zero."""

    gap: float = GAP  # scale of the tolerances
    losses: float = 1.0  # scale of hysteresis and joint friction; of a rod, scale of the regulators' deadband
    noise: float = 1.0  # scale of the noise of all sensors
    per_section: int | None = None  # links or elements per section; None: the twin's own number
    zero_m: float = 0.0  # size of the shift of each spring's zero; its sign is drawn from the seed
    softening: float = 0.0  # share of their stiffness that the chambers have lost
    lost: int | None = None  # chamber that never has pressure, as if it had burst


AS_BUILT = Build()
EXACT = Build(gap=0.0)  # parts as specified; losses and noise stay
AGED = Build(zero_m=1e-3, softening=0.05)  # the same arm, some months after its calibration


def drawn(rng: np.random.Generator, deviation: float, *shape: int) -> np.ndarray:
    """Draw deviations of parts by their standard deviation; parts beyond `WIDEST_DRAW` are clipped to it."""
    return deviation * np.clip(rng.standard_normal(shape), -WIDEST_DRAW, WIDEST_DRAW)


def scaled_tolerances(tolerances: Any, gap: float, spec: ArmSpec, **factors: np.ndarray) -> Any:
    """Return the tolerances of an arm, from a dataclass with the paper's arm's tolerances.

    All are multiplied by the gap. Lengths, whose names end in `_m`, are in proportion to the arm's lengths;
    other fields are multiplied by `factors`, by name.
    """
    paper = ArmSpec.default()
    length = float(np.mean(spec.geometry.section_length_m) / np.mean(paper.geometry.section_length_m))
    scaled = {
        name: gap * x * (length if name.endswith("_m") else factors.get(name, 1.0))
        for name, x in dataclasses.asdict(tolerances).items()
    }
    return dataclasses.replace(tolerances, **scaled)


class InstrumentedArm(abc.ABC):
    """An arm with noisy sensors and cameras; an `ArmIO` with motion capture.

    The seed chooses the twin, the session its noise; `sensor` is the arm's own.
    """

    _air: Pneumatics  # a kind of twin makes it

    def __init__(self, spec: ArmSpec, sensor: Sensor, seed: int, session: int, build: Build):
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(2,)))
        shift_m = build.zero_m * (2 * rng.integers(2, size=np.size(sensor.delta_m)) - 1)
        self._spec = spec
        self._sensor = dataclasses.replace(sensor, delta_m=sensor.delta_m + shift_m)
        self._scale = build.noise
        n = spec.n_chambers
        if build.lost is not None and build.lost >= n:
            raise ValueError(f"got lost{build.lost}, expected a chamber of this arm, lost0 to lost{n - 1}")
        self._lost = build.lost
        self._rng = np.random.default_rng([session, seed])
        self.time_s = 0.0

    @abc.abstractmethod
    def _lengths_m(self) -> np.ndarray:
        """Return the springs' true lengths (n,)."""

    @abc.abstractmethod
    def _hang(self, payload_kg: float) -> None:
        """Replace the payload at the finger tips."""

    def attach(self, payload_kg: float) -> None:
        """Hang a payload to the finger tips, in place of an earlier payload; 0 is none.

        Raises:
            ValueError: the mass is negative or not finite.
        """
        if not (np.isfinite(payload_kg) and payload_kg >= 0.0):
            raise ValueError(f"payload_kg: got {payload_kg!r}, expected a number >= 0")
        self._hang(payload_kg)

    def read_sensors(self) -> np.ndarray:
        """Return readings (n,) of the springs' sensors: noisy, in steps of the converter; see `ArmIO`."""
        true = self._sensor.readings(self._lengths_m())
        noisy = true + self._draw(self._sensor.noise, len(true))
        return np.round(noisy / self._sensor.resolution) * self._sensor.resolution

    def pressures(self) -> np.ndarray:
        """Return pressures (n,) [kPa] in the chambers, as the regulators' sensors measure them."""
        return self._air.pressure_kpa + self._draw(PRESSURE_NOISE_KPA, self._spec.n_chambers)

    def _capture_turn(self) -> np.ndarray:
        """Draw the turn (3, 3) by which motion capture sees the tip's rotation off."""
        return rotation_about(np.radians(self._draw(CAPTURE_NOISE_DEG, 3)))

    def _capture(self, tip_m: np.ndarray, rotation: np.ndarray, marker_m: np.ndarray) -> Capture:
        """Return tip (3,) and markers (k, 3) with noise; the tip's rotation (3, 3) already has its noise."""
        noise_m = self._draw(CAPTURE_NOISE_M, len(marker_m) + 1, 3)
        length_m = self._lengths_m()
        spring_m = length_m + self._draw(SPRING_NOISE_M, len(length_m))
        quaternion = quaternion_from_rotation(rotation)
        return Capture(tip_m + noise_m[0], quaternion, marker_m + noise_m[1:], spring_m)

    def _commands(self, pressure_kpa: np.ndarray) -> np.ndarray:
        """Return the commands (n,) [kPa] that the regulators take: clipped, and none for a lost chamber.

        Raises:
            ValueError: the shape is wrong, or a pressure is beyond the arm's limits.
        """
        n, chambers = self._spec.n_chambers, self._spec.chambers
        low, high = chambers.pressure_min_kpa, chambers.pressure_max_kpa
        command = np.asarray(pressure_kpa, float)
        if command.shape != (n,):
            raise ValueError(f"pressure_kpa: got shape {command.shape}, expected ({n},)")
        within = (command >= low - PRESSURE_TOLERANCE_KPA) & (command <= high + PRESSURE_TOLERANCE_KPA)
        if not within.all():
            chamber = int(np.argmin(within))
            text = f"got {command[chamber]:g}, expected {low:g} to {high:g} kPa"
            raise ValueError(f"pressure_kpa[{chamber}]: {text}")
        return np.where(np.arange(n) == self._lost, 0.0, np.clip(command, low, high))

    def _draw(self, deviation: float, *shape: int) -> np.ndarray:
        return self._scale * deviation * self._rng.standard_normal(shape)
