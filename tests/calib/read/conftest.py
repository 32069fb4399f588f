"""Files for the tests of reading."""

import pytest

from mjx_softarm.logs.schema import write_log
from tests.calib.read.arm_logs import arm_log


@pytest.fixture
def file(tmp_path):
    """Function that writes a log with changed values and returns its path."""

    def write(name="arm.csv", **changes):
        write_log(tmp_path / name, arm_log(**changes))
        return tmp_path / name

    return write


@pytest.fixture
def text(tmp_path):
    """Function that writes a file as given and returns its path."""

    def write(content, name="arm.csv"):
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write
