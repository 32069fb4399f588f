"""Logs replayed and shared, without a browser."""

import numpy as np
import pytest

from mjx_softarm._support.errors import InputError
from mjx_softarm.logs.schema import write_log
from tests.linear_arm import GOALS, SPEC, LinearArm, go

pytest.importorskip("viser", reason="needs viser: pip install -e '.[view]'")
from mjx_softarm.view.__main__ import main
from mjx_softarm.view.replay import SHARE_HZ, ReplayPage, Timeline, share


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    path = tmp_path_factory.mktemp("logs") / "run.csv"
    write_log(path, go(LinearArm(), goals=GOALS[:1], duration_s=2.0).log)
    return path


def test_track_shows_the_row_of_a_time(path):
    track = Timeline(path, SPEC)
    assert track.end_s == pytest.approx(1.98) and track.name == "run.csv"
    assert track.at(-1.0).time_s == 0.0 and track.at(1e9).time_s == pytest.approx(1.98)
    assert track.at(0.51).time_s == pytest.approx(0.50)
    np.testing.assert_allclose(track.at(1.0).goal, GOALS[0], atol=1e-4)


def test_track_goes_without_rows_out_of_order(path, tmp_path):
    header, *rows = path.read_text().splitlines()
    rows[10], rows[20] = "nan" + rows[10][rows[10].index(",") :], rows[3]
    (tmp_path / "a.csv").write_text("\n".join([header, *rows]))
    assert Timeline(tmp_path / "a.csv", SPEC).at(0.41).time_s == pytest.approx(0.38)
    (tmp_path / "b.csv").write_text(header + "\n" + "nan" + rows[0][rows[0].index(",") :])
    with pytest.raises(InputError, match=r"b\.csv: got no rows, expected some"):
        Timeline(tmp_path / "b.csv", SPEC)


def test_replay_plays_at_its_speed_pauses_and_begins_anew(path, server):
    page = ReplayPage(server, SPEC, [Timeline(path, SPEC), Timeline(path, SPEC)])
    page.refresh(0.5)
    page._speed.value = "2"
    page.refresh(0.5)
    assert page._time.value == pytest.approx(1.5)
    page._play.value = False
    page.refresh(0.3)
    assert page._time.value == pytest.approx(1.5) and "1.50 s of 2.0 s" in page._panels[1]._text.content
    page._play.value = True
    page.refresh(0.5)
    assert page._time.value == 0.0


def test_long_log_is_shared_faster(path, tmp_path, monkeypatch):
    monkeypatch.setattr("mjx_softarm.view.replay.SHARE_FRAMES", 7)
    assert share(tmp_path / "run.html", SPEC, [Timeline(path, SPEC)]) == int(np.ceil(1.98 * SHARE_HZ / 7))
    text = (tmp_path / "run.html").read_text()
    assert "__VISER_EMBED_DATA__" in text and text.rstrip().endswith("</html>")


def test_command_line(path, tmp_path, capsys):
    (tmp_path / "other").mkdir()
    for words, message in (
        (("--html", tmp_path / "a.html"), "--html: got no log, expected one or more"),
        ((path, "--html", tmp_path / "a.xlsx"), "expected a name that ends in .html or .htm"),
        (("--demos", tmp_path / "a.mcap"), "expected a name that ends in .csv or .npz"),
        ((tmp_path / "other",), "other: got 'Is a directory', expected a log"),
    ):
        assert main([*map(str, words)]) == 2
        assert message in (error := capsys.readouterr().err) and error.count("\n") == 1
    assert main([str(path), "--html", str(tmp_path / "a.html")]) == 0
    assert capsys.readouterr().out.startswith(f"wrote {tmp_path / 'a.html'}, ")
