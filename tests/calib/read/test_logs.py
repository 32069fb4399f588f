"""Logs with planted faults: each is found, named with line and column, and costs what it must."""

import dataclasses

import numpy as np
import pytest

from calib.read.logs import read_log, same_arm, template
from mjx_softarm.logs import checks
from mjx_softarm.logs.checks import LogError
from mjx_softarm.logs.schema import UNITS, Log, log_columns, log_table, write_log

N = 400


def arm_log(n=N, seed=0, rate_hz=50.0, **changes):
    """A moving arm of nine chambers with noise, markers on three plates, the last being the tip."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(n) / rate_hz
    swing = np.sin(2.0 * np.pi * (0.3 * time_s[:, None] + rng.uniform(size=9)))
    half = 0.4 * swing[:, 0] + 1e-3 * rng.standard_normal(n)
    tip_m = np.stack([0.1 * swing[:, 1], 0.2 * swing[:, 0], -0.6 + 0.05 * swing[:, 2]], axis=1)
    tip_m += 1e-4 * rng.standard_normal((n, 3))
    log = Log(
        source="arm.csv",
        row=np.arange(n) + 2,
        time_s=time_s,
        readings=4e6 + 3e5 * swing + 1e3 * rng.standard_normal((n, 9)),
        spring_m=0.2 + 0.03 * swing + 3e-4 * rng.standard_normal((n, 9)),
        pressure_kpa=-10.0 + 15.0 * swing + 0.1 * rng.standard_normal((n, 9)),
        tip_m=tip_m,
        tip_quaternion=np.stack([np.cos(half), np.sin(half), 0.0 * half, 0.0 * half], axis=1),
        marker_m=tip_m[:, None] * np.array([0.0, 0.5, 1.0])[:, None] + 1e-4 * rng.standard_normal((n, 3, 3)),
        payload_kg=np.full(n, 0.1),
    )
    return dataclasses.replace(log, **changes)


@pytest.fixture
def file(tmp_path):
    """Writes a log after its values were changed, and gives the path."""

    def write(name="arm.csv", **changes):
        write_log(tmp_path / name, arm_log(**changes))
        return tmp_path / name

    return write


@pytest.fixture
def text(tmp_path):
    """Writes a file as given."""

    def write(content, name="arm.csv"):
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write


def planted(group, rows, value, columns=slice(None)):
    """Values of a group with some replaced."""
    values = np.array(getattr(arm_log(), group))
    values[rows, ..., columns] = value
    return {group: values}


def simple(rows, header="time [s],tip_x [m],tip_y [m],tip_z [m]"):
    return header + "\n" + "".join(f"{row}\n" for row in rows)


def moving(n, start=0):
    return [f"{0.02 * k:.2f},{0.01 * k:.3f},{-0.005 * k:.3f},{-0.6 + 0.001 * k:.4f}" for k in range(start, n)]


@pytest.mark.parametrize("name", ["arm.csv", "arm.npz"])
@pytest.mark.parametrize("seed", range(5))
def test_clean_log_comes_back_without_findings(file, name, seed):
    log, findings = read_log(file(name, seed=seed), strict=True)
    assert findings == []
    expected = arm_log(seed=seed)
    np.testing.assert_array_equal(log.row, expected.row)
    for group in ("time_s", "readings", "spring_m", "tip_m", "tip_quaternion", "marker_m", "payload_kg"):
        np.testing.assert_allclose(getattr(log, group), getattr(expected, group), rtol=1e-8, atol=1e-9)
    assert log.goal is None and log.estimate is None and log.reference_m is None


@pytest.mark.parametrize("seed", range(5))
def test_a_row_per_pose_comes_back_without_findings(file, seed):
    """Separate poses, seconds apart, some of them held: no motion, so no jump, turn or spike."""
    rng = np.random.default_rng(seed)
    hold = np.repeat(np.arange(N // 2), rng.integers(2, 4, N // 2))[:N]
    quaternion = rng.standard_normal((N, 4)) * [1.0, 1.0, 1.0, 0.1]
    quaternion[:, 0] = 0.5 + np.abs(quaternion[:, 0])
    poses = {
        "spring_m": rng.uniform(0.105, 0.235, (N, 9))[hold],
        "readings": rng.uniform(3e6, 5e6, (N, 9))[hold],
        "pressure_kpa": rng.choice([-40.0, 0.0, 20.0], (N, 9))[hold],
        "tip_m": rng.uniform([-0.2, -0.2, -0.8], [0.2, 0.2, -0.4], (N, 3))[hold]
        + rng.normal(0.0, 1e-5, (len(hold), 3)),
        "tip_quaternion": (quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True))[hold],
        "marker_m": None,
        "time_s": 3.0 * np.arange(N),
    }
    assert read_log(file(**poses), strict=True)[1] == []


def test_units_and_order_of_the_file_do_not_matter(text):
    """Each unit of UNITS gives the same log, against factors known apart from the code."""
    known = {"ms": 1e-3, "kHz": 1e3, "MHz": 1e6, "mm": 1e-3, "cm": 1e-2, "Pa": 1e-3, "bar": 1e2, "mbar": 0.1}
    known |= {"psi": 6.894757293, "g": 1e-3, "rad": 57.29577951}
    expected = arm_log(n=20, goal=np.tile([0.0, 120.0, -500.0, 10.0, -20.0, 30.0], (20, 1)))
    columns, table = log_table(expected)
    inside = table * [UNITS[c.kind][c.unit] for c in columns]
    rng = np.random.default_rng(0)
    for trial in range(8):
        units = [rng.choice(list(UNITS[c.kind])) for c in columns]
        pose_mm = {"m": 1e3, "cm": 10.0, "mm": 1.0}
        factors = [
            pose_mm[u] if c.kind == "pose_length" else known.get(u, 1.0)
            for c, u in zip(columns, units, strict=True)
        ]
        order = rng.permutation(len(columns))
        header = ",".join(f"{columns[k].name} [{units[k]}]" for k in order)
        rows = (inside / factors)[:, order]
        body = "\n".join(",".join(f"{value:.12g}" for value in row) for row in rows)
        log, findings = read_log(text(f"{header}\n{body}\n", f"{trial}.csv"), strict=True)
        assert findings == []
        np.testing.assert_allclose(log_table(log)[1], table, rtol=1e-8, atol=1e-7)


def test_ids_of_demonstrations_are_read(file):
    sequence = np.repeat(np.arange(8.0), N // 8)
    log, findings = read_log(file(sequence=sequence), strict=True)
    assert findings == []
    np.testing.assert_array_equal(log.sequence, sequence)


def test_template_is_valid_and_its_text_names_all_columns(tmp_path):
    path = tmp_path / "template.csv"
    words = template(path)
    log, findings = read_log(path, strict=True)
    assert findings == [] and len(log) == 10
    assert not any(line.startswith("#") for line in path.read_text().splitlines())
    groups = {(c.group, c.kind): c.name for c in reversed(log_columns(9, 3))}
    assert all(f"\n{name} " in words for name in groups.values())
    with pytest.raises(FileExistsError, match="template.csv"):
        template(path)


# Rows at fault: group, rows, value, column of the finding, line of the first, rows that it costs.
FAULTS = {
    "NaN": ("readings", [7, 9], np.nan, [3], "frequency3", "2 x NaN or inf", (9, 11), 2),
    "inf": ("spring_m", [0], np.inf, [8], "spring8", "1 x NaN or inf", (2, 2), 1),
    "lost reading": (
        "readings",
        [50],
        0.0,
        [0],
        "frequency0",
        "first 0 Hz, expected 10000 Hz",
        (52, 52),
        1,
    ),
    "spring": ("spring_m", [60, 61], 0.26, [2], "spring2", "2 x outlier, first 260 mm", (62, 63), 2),
    "tip": ("tip_m", [200], 0.5, [1], "tip_y", "1 x outlier, first 500 mm", (202, 202), 1),
    "marker": ("marker_m", [10], -1.0, [2], "marker0_z", "1 x outlier, first -1000 mm", (12, 12), 1),
    "pressure": ("pressure_kpa", [33], 100.0, [4], "pressure4", "1 x outlier, first 100 kPa", (35, 35), 1),
    "no rotation": ("tip_quaternion", [5, 6], 0.3, slice(None), "tip_qw..qz", "2 x length not 1", (7, 8), 2),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_planted_fault_is_found_and_costs_its_rows(file, fault):
    group, rows, value, columns, column, problem, lines, cost = FAULTS[fault]
    changes = planted(group, rows, value)
    if not isinstance(columns, slice):
        clean = np.array(getattr(arm_log(), group))
        clean[np.ix_(rows, [0] if clean.ndim == 3 else columns, *([columns] if clean.ndim == 3 else []))] = (
            value
        )
        changes = {group: clean}
    path = file(**changes)
    log, findings = read_log(path)
    assert len(findings) == 1, list(map(str, findings))
    found = findings[0]
    assert (found.file, found.column, found.rows, found.n_dropped) == (str(path), column, lines, cost)
    assert problem in found.problem
    assert len(log) == N - cost and not set(np.array(rows) + 2) & set(log.row)
    with pytest.raises(LogError) as error:
        read_log(path, strict=True)
    assert str(error.value) == str(found)


def test_all_findings_are_in_the_message_of_strict(file):
    changes = planted("spring_m", [4], np.nan, 1) | planted("pressure_kpa", [8], np.nan, 2)
    with pytest.raises(LogError) as error:
        read_log(file(**changes), strict=True)
    assert [line.split(": ")[1:3] for line in str(error.value).splitlines()] == [
        ["line 6", "spring1"],
        ["line 10", "pressure2"],
    ]


def test_stale_motion_capture(file):
    log = arm_log()
    tip_m, quaternion = log.tip_m.copy(), log.tip_quaternion.copy()
    for k in (100, 101, 250):
        tip_m[k], quaternion[k] = tip_m[k - 1], quaternion[k - 1]
    tip_m[300] = tip_m[299]  # the orientation goes on: seen, though at the same place
    read, findings = read_log(file(tip_m=tip_m, tip_quaternion=quaternion))
    assert [(f.column, f.rows, f.n_dropped) for f in findings] == [("tip_x..z", (102, 252), 3)]
    assert set(log.row) - set(read.row) == {102, 103, 252}


def test_marker_at_rest_is_not_stale(file):
    marker_m = arm_log().marker_m
    marker_m[:, 0] = [0.0, 0.0, 0.01]
    assert read_log(file(marker_m=marker_m), strict=True)[1] == []


def test_sign_flips_are_repaired_and_cost_nothing(file):
    quaternion = arm_log().tip_quaternion
    quaternion[150:170] *= -1.0
    quaternion[300] *= -1.0
    log, findings = read_log(file(tip_quaternion=quaternion))
    assert [(f.rows, f.n_dropped) for f in findings] == [((152, 303), 0)]
    assert findings[0].problem.startswith("4 x sign flipped")
    np.testing.assert_allclose(log.tip_quaternion, arm_log().tip_quaternion, atol=1e-8)


def test_turns_that_jump_back_are_dropped(file):
    w, x, y, z = arm_log().tip_quaternion.T
    turned = np.stack([-z, y, -x, w], axis=1)  # q k: about the body's own z axis
    quaternion = arm_log().tip_quaternion
    rows = [*range(40, 60), *range(200, 203)]
    quaternion[rows] = turned[rows]
    log, findings = read_log(file(tip_quaternion=quaternion))
    assert findings[0].problem.startswith("23 x turned by 180 degrees") and findings[0].n_dropped == 23
    assert sorted(set(arm_log().row) - set(log.row)) == [row + 2 for row in rows]
    np.testing.assert_allclose(log.tip_quaternion[:, 0], np.delete(w, rows), atol=1e-8)


def test_rows_of_separate_poses_are_not_called_turned():
    quaternion = np.random.default_rng(0).standard_normal((2000, 4))
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    assert not checks.turned_rows(quaternion).any()


@pytest.mark.parametrize(
    ("change", "late"),
    [
        ({10: 0.18}, {10}),  # repeated
        ({10: 0.0}, {10}),  # one row back
        ({10: 99.0}, {10}),  # one row ahead costs itself, not all that follow
        ({20: 0.1, 21: 0.12, 22: 0.14}, {20, 21, 22}),
    ],
)
def test_times_that_do_not_increase(file, change, late):
    time_s = arm_log().time_s
    for row, value in change.items():
        time_s[row] = value
    log, findings = read_log(file(time_s=time_s))
    times = [f for f in findings if "repeated or going back" in f.problem]
    assert len(times) == 1 and times[0].n_dropped == len(late)
    assert set(arm_log().row - 2) - set(log.row - 2) == late
    assert (np.diff(log.time_s) > 0.0).all()


def test_gaps_and_constant_columns_are_reported_alone(file):
    time_s = arm_log().time_s
    time_s[100:] += 3.0
    pressure_kpa = arm_log().pressure_kpa
    pressure_kpa[:, 5] = 7.5
    log, findings = read_log(file(time_s=time_s, pressure_kpa=pressure_kpa))
    assert [(f.column, f.rows, f.n_dropped) for f in findings] == [
        ("time", (102, 102), 0),
        ("pressure5", (2, N + 1), 0),
    ]
    assert "longest 3.02 s, expected steps near 0.02 s" in findings[0].problem
    assert "always 7.5 kPa" in findings[1].problem
    assert len(log) == N


def test_frozen_tip_is_constant_and_not_stale(file):
    log, findings = read_log(file(**planted("tip_m", slice(None), [0.0, 0.0, -0.6])))
    assert [f.problem[:11] for f in findings] == ["never moves"] and len(log) == N


@pytest.mark.parametrize(
    ("wrong", "said", "column"),
    [
        ("spring0 [m]", "spring0 [mm]", "spring0"),
        ("spring0 [cm]", "spring0 [mm]", "spring0"),
        ("spring0 [mm]", "spring0 [m]", "spring0"),
        ("spring0 [mm]", "spring0 [cm]", "spring0"),
        ("frequency0 [MHz]", "frequency0 [Hz]", "frequency0"),
        ("frequency0 [kHz]", "frequency0 [Hz]", "frequency0"),
        ("frequency0 [Hz]", "frequency0 [MHz]", "frequency0"),
        ("pressure [Pa]", "pressure [kPa]", "pressure0"),
        ("pressure [kPa]", "pressure [Pa]", "pressure_kpa"),
        ("pressure [kPa]", "pressure [bar]", "pressure0"),
        ("tip_z [m]", "tip_z [mm]", "tip_z"),
        ("tip [m]", "tip [mm]", "tip_m"),
        ("tip [cm]", "tip [mm]", "tip_m"),
        ("tip_z [mm]", "tip_z [m]", "tip_z"),
        ("payload [kg]", "payload [g]", "payload_kg"),
        ("payload [g]", "payload [kg]", "payload"),
        ("time [ms]", "time [s]", "time"),
        ("time [s]", "time [ms]", "time"),
    ],
)
def test_wrong_unit_is_refused_by_name(text, wrong, said, column):
    columns, table = log_table(arm_log())
    name, unit = wrong.rstrip("]").split(" [")
    said_unit = said.rstrip("]").split(" [")[1]
    headers = [c.header for c in columns]
    table = table.copy()
    for k, c in enumerate(columns):
        if c.name.startswith(name) and c.kind != "number":
            table[:, k] *= UNITS[c.kind][c.unit] / UNITS[c.kind][unit]
            headers[k] = f"{c.name} [{said_unit}]"
    body = "\n".join(",".join(f"{value:.9g}" for value in row) for row in table)
    with pytest.raises(LogError) as error:
        read_log(text(",".join(headers) + "\n" + body + "\n"))
    assert column in {f.column for f in error.value.findings}
    assert "wrong unit" in str(error.value) or "z is up" in str(error.value)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("spring0", "frequency0"),
        ("spring4", "pressure4"),
        ("time", "tip_z"),
        ("tip_x", "tip_z"),
        ("tip_qw", "tip_z"),
    ],
)
def test_swapped_columns_are_refused(text, one, other):
    columns, table = log_table(arm_log())
    names = [c.name for c in columns]
    k, j = names.index(one), names.index(other)
    table = table.copy()
    table[:, [k, j]] = table[:, [j, k]]
    body = "\n".join(",".join(f"{value:.9g}" for value in row) for row in table)
    with pytest.raises(LogError) as error:
        read_log(text(",".join(c.header for c in columns) + "\n" + body + "\n"))
    assert {one, other} & {f.column for f in error.value.findings}


HEADER = "time [s],tip_x [m],tip_y [m],tip_z [m]"
UNREADABLE = {
    "empty": (b"", "empty file"),
    "blank": (b"\n \n", "empty file"),
    "header only": (HEADER + "\n", "a header and no rows"),
    "header without newline": (HEADER, "a header and no rows"),
    "one row": (simple(moving(1)), "1 row, expected 2 at least"),
    "all NaN": (
        simple([f"{0.1 * k},0.{k},nan,-0.6{k}" for k in range(9)]),
        "tip_y: no number in the whole column",
    ),
    "semicolons": (simple(moving(9)).replace(",", ";"), "line 1: .*got semicolons"),
    "tabs": (simple(moving(9)).replace(",", "\t"), "line 1: .*got tabs"),
    "semicolons in rows": (
        simple([r.replace(",", ";") for r in moving(9)]),
        "line 2: got 1 cells, and semicolons",
    ),
    "decimal commas": (
        simple([r.replace(".", ",") for r in moving(9)]),
        "line 2: got 8 cells; decimal commas?",
    ),
    "UTF-16": (simple(moving(9)).encode("utf-16"), "UTF-16 text, expected UTF-8"),
    "UTF-16 without mark": (simple(moving(9)).encode("utf-16-le"), "UTF-16 text, expected UTF-8"),
    "binary": (bytes(range(256)) * 40, "a binary file, expected CSV"),
    "latin-1": (
        "t\xe9mps [s],tip_x [m]\n".encode("latin-1"),
        "line 1: neither UTF-8 text nor npz: byte 0xe9 at 1",
    ),
    "late binary": ((simple(moving(4000)) + "\x00\x01,2,3,4\n").encode(), r"line 4002: time \[s\]: got"),
    "ragged": (simple([*moving(5), "0.1,0.2,0.3", *moving(9, 6)]), "line 7: got 3 cells; expected 4"),
    "cut off": (simple(moving(5)) + "0.1,0.0", "line 7: got 2 cells; expected 4"),
    "word": (simple([*moving(5), "0.1,0.2,off,0.3"]), r"line 7: tip_y \[m\]: got 'off', expected a number"),
    "no header": ("\n".join(moving(9)), "line 1: expected a header such as"),
    "no time": (simple(["0.1,0.2,-0.6"] * 3, HEADER[9:]), "time: missing, expected a column `time"),
    "time alone": ("time [s]\n0\n1\n", "parted by commas"),
    "nothing measured": (simple(["0,1", "1,1"], "time [s],payload [g]"), "expected frequency0.., spring0.."),
    "part of a group": (
        simple(["0,1", "1,1"], "time [s],tip_x [m]"),
        "tip_y, tip_z: missing, expected beside tip_x",
    ),
    "twice": (simple([f"{r},1" for r in moving(4)], HEADER + ",tip_x [m]"), "tip_x: 2 columns of this name"),
    "no unit": (
        simple(moving(9), HEADER.replace(" [s]", "")),
        r"time: got no unit, expected one of \[s\], \[ms\]",
    ),
    "unknown unit": (
        simple(moving(9), HEADER.replace("[s]", "[h]")),
        r"time: got \[h\], expected one of \[s\]",
    ),
    "other arm": (simple(["0,1", "1,1"], "time [s],spring9 [mm]"), "spring9: expected a log of 9 chambers"),
}


@pytest.mark.parametrize("case", UNREADABLE)
def test_unreadable_file_is_refused_in_readable_lines(text, case):
    content, message = UNREADABLE[case]
    path = text(content)
    with pytest.raises(LogError, match=message) as error:
        read_log(path)
    assert all(line.startswith(f"{path}: ") for line in str(error.value).splitlines())


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.npz", b"not a zip file", "expected an npz file"),
        ("a.npz", b"", "expected an npz file"),
        ("a.npz", b"PK\x03\x04" + b"\x00" * 50, "expected an npz file"),
        ("a.csv", b"PK\x03\x04" + b"\x00" * 50, "a binary file"),
    ],
)
def test_broken_npz(text, name, content, message):
    with pytest.raises(LogError, match=message):
        read_log(text(content, name))


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"columns": np.array(["time [s]"])}, "table is not a file"),
        (
            {"columns": np.array(["time [s]"]), "table": np.zeros((3, 2))},
            r"got columns \(1,\) of <U8, table \(3, 2\)",
        ),
        ({"columns": np.array(["time [s]"]), "table": np.array([["a"]])}, "of <U1"),
        ({"columns": np.array(["time [s]"]), "table": np.zeros((0, 1))}, "no rows"),
        ({"columns": np.array([{}]), "table": np.zeros((3, 1))}, "allow_pickle=False"),
    ],
)
def test_npz_of_other_things(tmp_path, arrays, message):
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(LogError, match=message):
        read_log(tmp_path / "a.npz")


def test_folder_missing_file_and_missing_permission(tmp_path, monkeypatch):
    for path, message in [
        (tmp_path, "Is a directory"),
        (tmp_path / "no.csv", "No such file"),
        (tmp_path / "no.npz", "No such"),
    ]:
        with pytest.raises(LogError, match=message) as error:
            read_log(path)
        assert str(error.value).startswith(f"{path}: ")

    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("pathlib.Path.open", refuse)  # chmod does not stop a superuser
    with pytest.raises(LogError, match="a.csv: Permission denied"):
        read_log(tmp_path / "a.csv")


def test_empty_cells_blank_lines_and_marks_of_other_programs(text):
    rows = moving(9)
    rows[3] = rows[3].split(",")[0] + ",,0.1,-0.6"
    content = "\ufeff" + simple(rows).replace("\n", "\r\n").replace("0.04,", "\r\n0.04,") + "\r\n"
    log, findings = read_log(text(content))
    assert [(f.column, f.rows) for f in findings] == [("tip_x", (6, 6))]
    assert list(log.row) == [2, 3, 5, 7, 8, 9, 10, 11]


def test_unknown_column_is_reported_and_ignored(text):
    log, findings = read_log(text(simple([f"{row},5" for row in moving(9)], HEADER + ",operator")))
    assert [(f.column, f.problem) for f in findings] == [("operator", "unknown column, ignored")]
    assert len(log) == 9


def test_steps_swings_and_quantised_columns_have_no_outliers():
    rng = np.random.default_rng(0)
    time = np.arange(20_000)
    step = (time // 200 % 2).astype(float)
    lagged = np.convolve(step, 0.2 * 0.8 ** np.arange(60))[: len(step)]
    for values in (
        step,
        lagged,
        lagged + 0.002 * rng.standard_normal(len(step)),
        step + 0.01 * rng.standard_normal(len(step)),
        np.round(lagged, 1),
        np.sin(2.0 * np.pi * time / 7.0),
        rng.uniform(size=len(step)),
        rng.standard_normal(len(step)),
        rng.laplace(size=len(step)),
        np.zeros(len(step)),
    ):
        assert not checks.outlier_rows(values, least=0.01).any()
    spiked = lagged + 0.002 * rng.standard_normal(len(step))
    rows = np.array([50, 510, 511, 9_950, 15_350])
    spiked[rows] += 0.5
    np.testing.assert_array_equal(np.flatnonzero(checks.outlier_rows(spiked, least=0.01)), rows)


def test_logs_of_one_arm_and_of_two():
    first = arm_log(source="a.csv")
    same_arm([first, arm_log(seed=1, source="b.csv"), arm_log(seed=2, source="c.csv")])
    for change, message in [
        ({"spring_m": 3.0 * first.spring_m}, "spring_m: 0.1.* and 0.5"),
        ({"readings": 0.5 * first.readings}, "readings: "),
        ({"tip_m": 2.0 * first.tip_m}, "tip_m: "),
        ({"pressure_kpa": first.pressure_kpa[:, :6]}, "pressure_kpa: 9 and 6 in a row"),
        ({"marker_m": first.marker_m[:, :2]}, "marker_m: 3 and 2 in a row"),
    ]:
        other = dataclasses.replace(first, source="b.csv", **change)
        with pytest.raises(LogError, match="a.csv and b.csv: " + message):
            same_arm([first, first, other])
    bare = dataclasses.replace(first, source="d.csv", marker_m=None, tip_m=None, tip_quaternion=None)
    same_arm([bare, first])  # a log need not have everything


def test_poses_recorded_by_hand_may_be_far_apart(tmp_path):
    slow = arm_log(n=40, rate_hz=1 / 30)
    write_log(tmp_path / "slow.csv", slow)
    assert len(read_log(tmp_path / "slow.csv")[0]) > 30
    long = arm_log(n=600, rate_hz=1 / 20)  # 50 Hz in milliseconds
    write_log(tmp_path / "long.csv", long)
    with pytest.raises(LogError, match=r"time: median step 20 s \(plausible in ms\)"):
        read_log(tmp_path / "long.csv")


def test_too_few_rows_left_are_refused_with_the_reasons(file):
    path = file(**planted("spring_m", slice(1, None), np.nan, 0))
    with pytest.raises(LogError, match="spring0: 399 x NaN or inf.*\n.*1 rows left, expected 2 at least"):
        read_log(path)


@pytest.mark.slow
def test_a_million_rows(tmp_path):
    """One of 23 columns, 0.2 GB; every row is there, and a fault near the end has its line."""
    rng = np.random.default_rng(0)
    tails = []
    for _ in range(997):
        values = (rng.uniform(100, 300, 9), rng.uniform(-40, 20, 9), rng.uniform(-200, 200, 2))
        tails.append(
            "".join(f",{value:.3f}" for value in np.concatenate(values)) + f",{-rng.uniform(500, 600):.3f}\n"
        )
    header = ["time [s]", *(f"spring{k} [mm]" for k in range(9)), *(f"pressure{k} [kPa]" for k in range(9))]
    header += [f"tip_{axis} [mm]" for axis in "xyz"]
    n = 1_000_000
    with (tmp_path / "long.csv").open("w") as out:
        out.write(",".join(header) + "\n")
        for start in range(0, n, 10_000):
            out.writelines(f"{0.02 * k:.2f}{tails[k % 997]}" for k in range(start, start + 10_000))
    with (tmp_path / "long.csv").open("r+b") as out:
        content = f"{0.02 * (n - 1):.2f}{tails[(n - 1) % 997]}"
        out.seek(-len(content), 2)
        out.write(content.replace(content.split(",")[1], "nan".ljust(len(content.split(",")[1])), 1).encode())
    log, findings = read_log(tmp_path / "long.csv")
    assert [(f.column, f.rows, f.n_dropped) for f in findings] == [("spring0", (n + 1, n + 1), 1)]
    assert len(log) == n - 1
    np.testing.assert_allclose(log.time_s[-1], 0.02 * (n - 2))
