"""Any file and any value is taken or refused by its name."""

import contextlib
import re

import pytest
import tomli_w
from hypothesis import given, settings
from hypothesis import strategies as st

from mjx_softarm import ArmSpec, SpecError
from tests.properties import damaged, few


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
