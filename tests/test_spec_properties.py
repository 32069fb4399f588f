"""Any specification is written and read again; any file and any value is taken or refused by its name."""

import contextlib
import re

import pytest
import tomli_w
from hypothesis import given, settings
from hypothesis import strategies as st

from mjx_softarm import ArmSpec, SpecError
from tests.properties import damaged, few

POSITIVE = st.floats(1e-6, 1e6)


@few
@given(
    name=st.text(max_size=12),
    mass_kg=st.floats(1e-6, 50.0),
    stiffness=st.one_of(POSITIVE, st.lists(POSITIVE, min_size=9, max_size=9).map(tuple)),
    gains=st.tuples(POSITIVE, POSITIVE, POSITIVE),
)
def test_any_specification_is_written_and_read_again(tmp_path, name, mass_kg, stiffness, gains):
    spec = ArmSpec.default().replace(
        name=name,
        mass={"arm_kg": mass_kg},
        chambers={"stiffness_n_per_m": stiffness},
        control=dict(zip(("rate_hz", "kp_kpa_per_m", "ki_kpa_per_ms"), gains, strict=True)),
    )
    spec.to_toml(tmp_path / "arm.toml")
    assert ArmSpec.from_toml(tmp_path / "arm.toml") == spec


@settings(few, max_examples=200)
@given(data=damaged(tomli_w.dumps(ArmSpec.default().to_dict()).encode()))
@pytest.mark.filterwarnings("error")
def test_a_damaged_file_is_read_or_refused_as_a_specification(tmp_path, data):
    (tmp_path / "arm.toml").write_bytes(data)
    with contextlib.suppress(SpecError):
        assert ArmSpec.from_toml(tmp_path / "arm.toml").n_chambers > 0


GROUPS = {name: group for name, group in ArmSpec.default().to_dict().items() if isinstance(group, dict)}
NUMBERS = [f"{group}.{name}" for group, fields in GROUPS.items() for name in fields if name != "kind"]


@settings(few, max_examples=200)
@given(path=st.sampled_from(NUMBERS), value=st.one_of(st.floats(), st.integers(), st.text(), st.none()))
@pytest.mark.filterwarnings("error")
def test_any_value_of_a_field_is_taken_or_refused_by_the_field_s_name(path, value):
    group, name = path.split(".")
    try:
        ArmSpec.default().replace(**{group: {name: value}})
    except SpecError as error:
        assert re.match(rf"replace: ({re.escape(path)}|springs\.|chambers\.|sensor\.)", str(error))
