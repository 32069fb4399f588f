"""The specification: the paper's numbers, the round trip, and messages that say what is wrong where."""

import copy
import math
from pathlib import Path

import pytest

from mjx_softarm import ArmSpec, SpecError


@pytest.fixture
def data(spec):
    return spec.to_dict()


def message_of(function, *args, **kwargs):
    with pytest.raises(SpecError) as caught:
        function(*args, **kwargs)
    return str(caught.value)


def changed(data, path, value):
    """A copy of nested dictionaries with one field set."""
    data = copy.deepcopy(data)
    *groups, name = path.split(".")
    part = data
    for group in groups:
        part = part[group]
    part[name] = value
    return data


def test_a_negative_bond_leaves_the_backbone_its_stiffness(spec):
    assert spec.replace(chambers={"bonded_share": -0.3}).shape_lag_s > spec.shape_lag_s
    assert spec.replace(chambers={"bonded_share": 0.5}).shape_lag_s < spec.shape_lag_s
    stiff = {"stiffness_n_per_m": 1200.0, "bonded_share": -0.3}
    assert "chambers.bonded_share: got -0.3, which takes more" in message_of(spec.replace, chambers=stiff)


def test_default_is_the_paper_s_arm(spec):
    """Its file holds each number; mass and coil are derived from what the paper prints."""
    assert (spec.name, spec.structure.n_sections) == ("paper", 3)
    assert (spec.geometry.chamber_diameter_m, spec.mass.gripper_kg) == (0.06, 0.45)
    assert (spec.sensor.beta, spec.sensor.delta_m, spec.control.rate_hz) == (0.93, 2.45e-3, 50.0)
    assert spec.mass.arm_kg + spec.mass.gripper_kg == pytest.approx(4.7)
    assert spec.sensor.coil_radius_m == pytest.approx((4.0 - 0.4) / 2 * 1e-3)
    assert spec.mass.largest_payload_kg == 1.0
    small = ArmSpec.of(Path("sopra")).mass  # in proportion to the arms' masses
    assert small.largest_payload_kg == pytest.approx((sum(small.arm_kg) + small.gripper_kg) / 4.7)


def test_a_count_is_refused_before_the_lists_that_follow_it(spec):
    changes = {"sensor": {"beta": [0.93] * 9}, "structure": {"springs_per_section": 2}}
    assert message_of(spec.replace, **changes).startswith("replace: structure.springs_per_section: got 2, ")


REFUSED = [
    # field, value, what follows the field in the message
    ("mass.gripper_length_m", "heavy", "got 'heavy', expected a number > 0 and <= 2 (m, not mm)"),
    ("mass.gripper_length_m", 10**400, f"got {10**400}, expected a number"),
    ("geometry.section_length_m", 200.0, "got 200.0, expected a number > 0 and <= 2 (m, not mm)"),
    ("backbone.axial_stiffness_n_per_m", math.nan, "got nan, expected a number > 0"),
    ("backbone.axial_stiffness_n_per_m", 1e39, "got 1e+39, expected sizes from"),
    ("structure.n_sections", 3.0, "got 3.0, expected a whole number >= 1"),
    ("structure.springs_per_section", 2, "got 2, expected 0 for one beside each chamber, or 3 or more"),
    ("structure.springs_per_section", 4, "got 4, expected 0 for one beside each chamber, or 3 or more"),
    ("mounting.base_turn_deg", [1.0], "got [1.0], expected a list of 3 numbers"),
    ("chambers.pressure_min_kpa", 20.0, "got 20.0, expected less than pressure_max_kpa (20.0)"),
    ("springs.rest_length_m", 0.7, "got 0.7 with geometry.section_length_m 0.2, expected lengths that go"),
    ("sensor.beta", [0.93] * 8, "got 8 numbers, expected one, or one for each of the 9 springs"),
    ("sensor.beta", [0.93] * 8 + [math.nan], "[8]: got nan, expected a number > 0"),
    ("sensor.kind", "laser", "got 'laser', expected coil or draw_wire"),
    ("sensor.delta_m", 0.09, "springs.length_min_m: got 0.085, which reads"),
    ("control.kd", 1.0, "got an unknown field"),
    ("actuators.kind", "bellows", "got 'bellows', expected pump or regulator"),
    ("name", {"first": "arm"}, "got {'first': 'arm'}, expected a text"),
    ("mass", 4.7, "got 4.7, expected a table"),
]


@pytest.mark.parametrize("path, value, expected", REFUSED, ids=lambda x: str(x)[:24])
def test_a_refused_value_is_named_with_file_field_and_expectation(data, path, value, expected):
    text = message_of(ArmSpec.from_dict, changed(data, path, value), "my.toml")
    field = "" if expected.startswith("springs.") else f"{path}{'' if expected.startswith('[') else ': '}"
    assert text.startswith(f"my.toml: {field}{expected}")


def test_a_missing_field_a_missing_group_and_an_unknown_one_are_named(spec, data):
    del data["mass"]["arm_kg"]
    assert message_of(ArmSpec.from_dict, data, "my.toml").startswith("my.toml: mass.arm_kg: got nothing")
    del data["mass"]
    assert message_of(ArmSpec.from_dict, data, "my.toml").startswith("my.toml: mass: got nothing")
    assert message_of(spec.replace, motors={}).startswith("replace: got unknown group 'motors'")


def test_sections_may_differ_and_have_fewer_springs_than_chambers(spec):
    arm = spec.replace(
        structure={"chambers_per_section": 6, "springs_per_section": 3},
        geometry={"section_length_m": [0.2, 0.18, 0.15]},
        mass={"arm_kg": [2.0, 1.5, 1.0]},
    )
    assert (arm.n_chambers, arm.n_springs) == (18, 9)
    assert arm.length_m == pytest.approx(0.53)
    assert arm.at_springs(arm.geometry.section_length_m).tolist() == [0.2] * 3 + [0.18] * 3 + [0.15] * 3
    assert arm.section_mass_kg == (2.0, 1.5, 1.0)
    assert ArmSpec.from_dict(arm.to_dict()) == arm
    text = message_of(arm.replace, springs={"length_min_m": [0.08, 0.08, 0.3]})
    assert "got (0.08, 0.08, 0.3), expected less than length_max" in text


def test_files_that_cannot_be_used_are_named(tmp_path, spec):
    path = tmp_path / "arm.toml"
    text = f"{path}: got 'No such file or directory', expected a specification"
    assert message_of(ArmSpec.of, path) == text
    for content in (b"name = \nmass", b"name = '\xff'"):
        path.write_bytes(content)
        text = message_of(ArmSpec.from_toml, path)
        assert text.startswith(f"{path}: got ") and text.endswith(", expected TOML")
    spec.to_toml(path)
    path.write_text(path.read_text("utf-8").replace("gripper_kg = 0.45", "gripper_kg = nan"), "utf-8")
    assert message_of(ArmSpec.from_toml, path).startswith(f"{path}: mass.gripper_kg: got nan, expected")


@pytest.mark.parametrize("name", ["paper", "sopra", "stiff-flop", "four-chamber"])
def test_arms_that_ship_have_names(name, tmp_path, monkeypatch):
    """A file of the same name comes first; a name that there is not is refused with those that there are."""
    monkeypatch.chdir(tmp_path)
    assert ArmSpec.of(Path(name)).name == name
    ArmSpec.default().replace(name="mine").to_toml(name)
    assert ArmSpec.of(Path(name)).name == "mine"
    expected = "nobody: got no such arm, expected a file, or four-chamber, paper, sopra, stiff-flop"
    assert message_of(ArmSpec.of, Path("nobody")) == expected


def test_actuators_are_the_paper_s_pumps_unless_a_file_says_otherwise(spec, data, tmp_path):
    del data["actuators"]
    assert ArmSpec.from_dict(data) == spec
    numbers = {"lag_s": [0.3 + 0.01 * k for k in range(9)], "dead_time_s": 0.1, "deadband_kpa": 0.2}
    numbers |= {"kind": "regulator", "fill_kpa_per_s": 60.0, "vent_kpa_per_s": 25.0}
    regulated = spec.replace(actuators=numbers)
    regulated.to_toml(tmp_path / "arm.toml")
    assert ArmSpec.from_toml(tmp_path / "arm.toml") == regulated != spec
    assert regulated.replace(actuators={"dead_time_s": 0.2}).actuators.lag_s == tuple(numbers["lag_s"])
    text = message_of(regulated.replace, actuators={"lag_s": [0.3] * 8})
    assert "lag_s: got 8 numbers, expected one, or one for each of the 9 chambers" in text
