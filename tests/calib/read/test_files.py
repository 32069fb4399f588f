"""Files that cannot be read are refused in readable lines; odd ones are read."""

import numpy as np
import pytest

from calib.read.logs import read_log
from mjx_softarm.logs.checks import LogError
from tests.calib.read.arm_logs import HEADER, moving, simple

UNREADABLE = {
    "empty": (b"", "empty file"),
    "mark alone": (b"\xef\xbb\xbf", "empty file"),
    "one row": (simple(moving(1)), "got 1 row, expected 2 at least"),
    "all NaN": (simple([f"{0.1 * k},0.{k},nan,-0.6" for k in range(9)]), "tip_y: got no number in the whole"),
    "semicolons": (simple(moving(9)).replace(",", ";"), "line 1: .*got semicolons"),
    "decimal commas": (simple([r.replace(".", ",") for r in moving(9)]), "2: got 8 cells .decimal commas"),
    "UTF-16": (simple(moving(9)).encode("utf-16"), "UTF-16 text, expected UTF-8"),
    "UTF-16 without a mark": (simple(moving(9)).encode("utf-16-le"), "UTF-16 text, expected UTF-8"),
    "binary": (bytes(range(256)) * 40, "a binary file, expected CSV"),
    "Latin-1": (simple(moving(9), HEADER + ",für").encode("latin-1"), "line 1: got byte 0xfc at 40"),
    "late binary": ((simple(moving(4000)) + "\x00\x01,2,3,4\n").encode(), r"line 4002: time \[s\]: got"),
    "ragged": (simple([*moving(5), "0.1,0.2,0.3", *moving(9, 6)]), "line 7: got 3 cells, expected 4"),
    "word": (simple([*moving(5), "0.1,0.2,off,0.3"]), r"line 7: tip_y \[m\]: got 'off', expected a number"),
    "no header": ("\n".join(moving(9)), "expected a header such as"),
    "no time": (simple(["0.1,0.2,-0.6"] * 3, HEADER[9:]), "time: got nothing, expected `time"),
    "nothing measured": (simple(["0,1", "1,1"], "time [s],payload [g]"), "expected frequency0.., spring0.."),
    "part of a group": (simple(["0,1", "1,1"], "time [s],tip_x [m]"), "tip_y, tip_z: got no .* beside tip_x"),
    "twice": (simple([f"{r},1" for r in moving(4)], HEADER + ",tip_x [m]"), "tip_x: got 2 columns of this"),
    "no unit": (simple(moving(9), HEADER.replace(" [s]", "")), r"time: got no unit, expected one of \[s\]"),
    "other arm": (
        simple(["0,1", "1,1"], "time [s],spring9 [mm]"),
        "spring9: got this column, expected spring0",
    ),
    "other sensor": (simple(["0,1", "1,1"], "time [s],voltage0 [V]"), "voltage0: got readings of another"),
}


@pytest.mark.parametrize("case", UNREADABLE)
def test_unreadable_file_is_refused_in_readable_lines(text, case):
    content, message = UNREADABLE[case]
    path = text(content)
    with pytest.raises(LogError, match=message) as error:
        read_log(path)
    assert all(line.startswith(f"{path}: ") for line in str(error.value).splitlines())


@pytest.mark.parametrize(
    ("columns", "table", "message"),
    [
        (["time [s]"], None, "table is not a file"),
        (["time [s]"], np.zeros((3, 2)), r"got columns \(1,\) of <U8, table \(3, 2\)"),
        (["time [s]"], np.zeros((0, 1)), "no rows"),
        ([{}], np.zeros((3, 1)), "allow_pickle=False"),
    ],
)
def test_npz_of_other_things(tmp_path, columns, table, message):
    np.savez(tmp_path / "a.npz", columns=np.array(columns), **({} if table is None else {"table": table}))
    with pytest.raises(LogError, match=message):
        read_log(tmp_path / "a.npz")


def test_empty_cells_blank_lines_unknown_columns_and_marks_of_other_programs(text):
    rows = moving(9)
    rows[3] = rows[3].split(",")[0] + ",,0.1,-0.6"
    rows = [f"{row},5" for row in rows]
    content = simple(rows, HEADER + ",operator").replace("\n", "\r\n").replace("0.04,", "\r\n0.04,")
    log, findings = read_log(text("\ufeff" + content + "\r\n"))
    assert [(f.column, f.rows) for f in findings] == [("operator", (1, 1)), ("tip_x", (6, 6))]
    assert list(log.row) == [2, 3, 5, 7, 8, 9, 10, 11]
