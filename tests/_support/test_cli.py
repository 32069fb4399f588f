"""Command lines: options of every kind, and an error on stderr for each mistake."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import pytest
import tyro

from mjx_softarm._support import cli, errors

PRESETS = {"small": 1.0, "large": 9.0}


@dataclass(frozen=True)
class Inner:
    gamma: float = 0.5  # discount


@dataclass(frozen=True)
class Settings:
    n: int = 1
    size: float = 0.0
    noisy: bool = True
    inner: Inner = field(default_factory=Inner)

    def __post_init__(self):
        if self.n < 1:
            raise ValueError(f"n: got {self.n}, expected at least 1")


@dataclass(frozen=True, kw_only=True)
class Make:
    """Make something."""

    preset: Annotated[str, cli.one_of(PRESETS)] = "small"
    settings: Annotated[Settings, tyro.conf.arg(name="")] = field(default_factory=Settings)
    out: cli.MaybePath = None

    @classmethod
    def default(cls, arguments):
        return cls(settings=Settings(size=PRESETS["large" if "large" in arguments else "small"]))

    def __call__(self):
        RESULTS.append(self)
        return 0


def show(
    files: tyro.conf.Positional[tuple[Path, ...]], seeds: cli.Integers = (0,), strict: bool = False
) -> int:
    """Show files."""
    RESULTS.append((files, seeds, strict))
    return 3


def fail(how: Literal["bug", "file", "gone", "interrupt"]) -> int:
    """Fail."""
    if how == "file":
        Path("absent/file").read_text()
    errors = {"bug": ValueError("a bug"), "gone": BrokenPipeError(32, "gone")}
    raise errors.get(how, KeyboardInterrupt())


RESULTS = []
COMMANDS = {"make": Make, "show files": show, "fail": fail, "late": "late_module:late"}


def run(*words):
    RESULTS.clear()
    return cli.main("program", "About it.", COMMANDS, list(words))


def test_options_reach_every_level_and_begin_with_the_preset(tmp_path):
    assert run("show", "files", "a", "b", "--seeds", "2,0,2", "--strict") == 3
    assert [((Path("a"), Path("b")), (0, 2), True)] == RESULTS
    words = ("--n", "3", "--inner.gamma", "0.9", "--out", str(tmp_path))
    assert run("make", "--preset", "large", *words) == 0
    made = Make(preset="large", settings=Settings(3, 9.0, inner=Inner(0.9)), out=tmp_path)
    assert [made] == RESULTS
    assert run("make") == 0 and RESULTS[0].settings == Settings(size=1.0)


@pytest.mark.parametrize(
    "words, printed",
    [
        ("make --inner.gama 1", "--inner.gama, 1|--inner.gamma FLOAT"),
        ("make --preset huge", "'--preset'|'huge'|Expected one of ('small', 'large')"),
        ("show files --seeds 0,a", "--seeds: got '0,a', expected whole numbers|N,N,..."),
        ("fail", "Missing from program fail:|--how {bug,file,gone,interrupt}"),
        ("dance", "error: program: got 'dance', expected one of make, show files, fail, late"),
        ("show dance", "error: program: got 'show dance', expected one of make, show files"),
        ("make --n 0", "error: n: got 0, expected at least 1"),
        ("fail --how file", "error: absent/file: got 'No such file or directory', expected a file"),
        ("fail --how gone", "error: [Errno 32] gone"),  # of an arm's connection, not of the output
    ],
)
def test_a_mistake_is_printed_with_what_it_may_be_and_status_2(words, printed, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")  # no message is broken into lines
    assert run(*words.split()) == 2 and RESULTS == []
    out, err = capsys.readouterr()
    assert out == "" and all(part in err for part in printed.split("|"))
    assert not printed.startswith("error") or err.count("\n") == 1


@pytest.mark.parametrize(
    "code, status, printed", [(None, 0, ""), (3, 3, ""), ("no serial port", 2, "error: no serial port\n")]
)
def test_a_program_that_ends_itself_keeps_its_status_or_its_message(code, status, printed, capsys):
    assert cli.guarded(lambda: sys.exit(code)) == status
    assert capsys.readouterr().err == printed


PRINTS = """
import sys
from mjx_softarm._support import cli

def many(n: int) -> int:
    for _ in range(n):
        print("line", flush=True)
    return 0

sys.exit(cli.main("program", "About it.", {"many": many}))
"""


@pytest.mark.parametrize(
    "words, together, status",
    [("many --n 2", False, 141), ("many --n one", True, 141), ("many --n one", False, 2)],
)
def test_a_command_whose_output_is_not_read_ends_quietly(words, together, status):
    """The reader has ended before the first line, on both streams where they go one way."""
    unread, output = os.pipe()
    os.close(unread)
    errors = output if together else subprocess.PIPE
    ended = subprocess.run([sys.executable, "-c", PRINTS, *words.split()], stdout=output, stderr=errors)
    os.close(output)
    assert ended.returncode == status and bool(ended.stderr) == (status == 2)


def test_a_bug_is_not_taken_for_a_mistake_of_the_user():
    with pytest.raises(ValueError, match="a bug"):
        run("fail", "--how", "bug")
    assert run("fail", "--how", "interrupt") == 130


def test_help_tells_every_option_and_imports_no_command(capsys, tmp_path, monkeypatch):
    text = 'raise ImportError\n\ndef late():\n    """Come late.\n\n    More."""'
    (tmp_path / "late_module.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    assert run() == run("--help") == 0
    assert "late        Come late.\n" in capsys.readouterr().out
    assert run("show") == 0
    assert "  show files  Show files." in (listed := capsys.readouterr().out) and "make" not in listed
    assert run("make", "--help") == 0
    printed = capsys.readouterr().out
    # A setting that begins as true is shown by its own name, not by its opposite alone.
    assert all(text in printed for text in ("--inner.gamma FLOAT", "discount", "--noisy, --no-noisy"))
    assert run("make", "--no-noisy") == 0 and not RESULTS[0].settings.noisy


def test_a_package_of_an_extra_is_named_where_it_is_missing(capsys, monkeypatch, tmp_path):
    def run():
        raise ModuleNotFoundError("No module named 'jax.numpy'", name="jax.numpy")

    assert cli.guarded(run) == 2
    assert "got no jax.numpy, expected pip install -e '.[train]' in the checkout" in capsys.readouterr().err
    monkeypatch.setattr(errors, "__file__", str(tmp_path / "mjx_softarm/_support/errors.py"))
    assert cli.guarded(run) == 2
    assert "expected pip install 'mjx-softarm[train]'" in capsys.readouterr().err
    with pytest.raises(ModuleNotFoundError):  # a bug of ours, or a user's
        cli.guarded(lambda: __import__("no_such_module"))
