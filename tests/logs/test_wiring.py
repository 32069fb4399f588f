"""Wiring by the log of a rod, and of the same rod with other numbers at its valves and sensors."""

import dataclasses

import numpy as np
import pytest

from calib.__main__ import main
from mjx_softarm import ArmSpec
from mjx_softarm.logs.schema import Log, write_log
from mjx_softarm.logs.wiring import wiring_faults
from mjx_softarm.mechanics.excitation import random_pressures
from mjx_softarm.twin.rod_twin import RodTwin

SPEC = ArmSpec.default()


@pytest.fixture(scope="module")
def log():
    """Rows of a rod at rest, two at each of a hundred random pressures."""
    rod = RodTwin(3)
    kpa = random_pressures(SPEC, 100, 0)
    readings = []
    for target_kpa in kpa:
        rod.settle(target_kpa)
        readings += [rod.read_sensors(), rod.read_sensors()]
    time_s = np.arange(len(readings), dtype=float)
    pressure_kpa = np.repeat(kpa, 2, axis=0)
    return Log("rod", np.arange(len(time_s)), time_s, np.array(readings), pressure_kpa=pressure_kpa)


@pytest.mark.parametrize(("first", "second"), [(0, 4), (1, 2)])
def test_exchanged_sensors_and_valves_are_named(log, first, second):
    assert wiring_faults(log, SPEC) == []
    order = np.arange(9)
    order[[first, second]] = second, first
    for other in (
        dataclasses.replace(log, readings=log.readings[:, order]),
        dataclasses.replace(log, pressure_kpa=log.pressure_kpa[:, order]),
    ):
        faults = wiring_faults(other, SPEC)
        assert len(faults) == 2
        assert f"chamber{first} that moves the springs beside chamber{second}" in faults[0]
        assert f"chamber{second} that moves the springs beside chamber{first}" in faults[1]


def test_a_log_of_exchanged_sensors_is_named_and_refused_if_strict(log, tmp_path, capsys):
    path = tmp_path / "exchanged.npz"
    write_log(path, dataclasses.replace(log, readings=log.readings[:, [4, 1, 2, 3, 0, 5, 6, 7, 8]]))
    assert main(["check", str(path)]) == 1
    assert f"{path}: wiring: got chamber0 that moves" in capsys.readouterr().out
    assert main(["check", str(path), "--strict"]) == 2
    assert f"{path}: wiring: got chamber0 that moves" in capsys.readouterr().err


def test_lengths_of_another_spring_are_named(log):
    """Lengths that were measured with a ruler, in a table whose columns were exchanged."""
    ruler_m = SPEC.spring_sensor.lengths(log.readings, np.nan).length_m
    assert wiring_faults(dataclasses.replace(log, spring_m=ruler_m), SPEC) == []
    exchanged = dataclasses.replace(log, spring_m=ruler_m[:, [0, 1, 2, 4, 3, 5, 6, 7, 8]])
    faults = wiring_faults(exchanged, SPEC)
    assert len(faults) == 2
    assert "lengths of spring3 that follow the readings of spring4" in faults[0]
    assert "lengths of spring4 that follow the readings of spring3" in faults[1]


def test_no_air_a_closed_valve_and_a_loose_sensor_are_named(log):
    noise_hz = 50.0 * np.random.default_rng(0).normal(size=log.readings.shape)
    still_hz = log.readings[0] + noise_hz
    [fault] = wiring_faults(dataclasses.replace(log, readings=still_hz), SPEC)
    assert "no air" in fault
    loose = np.where(np.arange(9) == 5, still_hz, log.readings)
    [fault, *_] = wiring_faults(dataclasses.replace(log, readings=loose), SPEC)
    assert "spring5 that follows no pressure" in fault
    valve_kpa = np.random.default_rng(1).uniform(-40.0, 20.0, len(log))
    commands = np.where(np.arange(9) == 7, valve_kpa[:, None], log.pressure_kpa)
    faults = wiring_faults(dataclasses.replace(log, pressure_kpa=commands), SPEC)
    assert "chamber7 that moves no spring" in faults[-1]
    assert all("chamber7" in fault or "spring7" in fault for fault in faults)


def test_poses_in_which_pressures_go_together_show_nothing(log):
    swapped_hz = log.readings[:, [4, 1, 2, 3, 0, 5, 6, 7, 8]]
    together = np.outer(np.sin(np.arange(len(log))), np.arange(1.0, 10.0))
    way = dataclasses.replace(log, pressure_kpa=together, readings=swapped_hz)
    assert wiring_faults(way, SPEC) == []
