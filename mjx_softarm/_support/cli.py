"""Command lines: tyro reads the options of a command; an error is printed on stderr, with exit status 2.

A command is a function, or a dataclass that is called once its options are read.
"""

from __future__ import annotations

import ast
import functools
import importlib.util
import inspect
import itertools
import os
import pkgutil
import select
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.constructors import PrimitiveConstructorSpec

from mjx_softarm._support.errors import InputError, missing

ERROR, INTERRUPTED, UNREAD = 2, 130, 141  # exit statuses; the last is a shell's for SIGPIPE
STDOUT = 1  # file descriptor
# Packages of the extra `train` that modules import as they are loaded.
TRAIN = {"flax", "jax", "jinja2", "matplotlib", "mujoco", "optax", "orbax", "rich", "scipy"}

Command = Callable[..., Any] | str


def main(
    prog: str,
    about: str,
    commands: Mapping[str, Command],
    arguments: Sequence[str] | None = None,
    finish: Callable[[str, Any], int] = lambda name, status: status,
) -> int:
    """Run the command that the arguments begin with, or list the commands; return the exit status.

    Args:
        prog: the program as its user calls it.
        about: a sentence about the program.
        commands: functions by name, or texts MODULE:NAME, which are imported only when they run.
        arguments: words of the command line, by default those of this process.
        finish: turns a command's name and its result into an exit status.
    """
    words = sys.argv[1:] if arguments is None else list(arguments)

    def run() -> int:
        for name, command in commands.items():
            n_words = len(name.split())
            if words[:n_words] == name.split():
                function = pkgutil.resolve_name(command) if isinstance(command, str) else command
                return finish(name, parse(function, f"{prog} {name}", words[n_words:])())
        # List all commands, or those of a group such as `demos`.
        group = list(itertools.takewhile(lambda word: not word.startswith("-"), words))
        shown = [name for name in commands if name.split()[: len(group)] == group]
        if not shown:
            raise InputError(f"{prog}: got {' '.join(group)!r}, expected one of {', '.join(commands)}")
        width = max(map(len, shown))
        lines = [f"  {name:{width}}  {_line(commands[name])}" for name in shown]
        print("\n".join([f"usage: {prog} COMMAND [--help] ...", "", about, "", *lines]))
        return 0

    return guarded(run)


def guarded(run: Callable[[], int]) -> int:
    """Run a command; return its exit status: 2 after an error that the user can put right, 130 after Ctrl-C.

    It is 141 where the reader of the output has ended, as `head` does. Such a command ends quietly.
    """
    try:
        status = _status(run)
        print(end="", flush=True)  # a closed pipe is met here, not as Python ends
    except BrokenPipeError:
        # The rest of the output goes nowhere, as https://docs.python.org/3/library/signal.html#note-on-sigpipe
        # advises. SIGPIPE stays ignored, since it would end a command whose arm is under pressure.
        os.dup2(os.open(os.devnull, os.O_WRONLY), STDOUT)
        return UNREAD
    return status


def _status(run: Callable[[], int]) -> int:
    """Return a command's exit status; print errors that its user can put right."""
    try:
        return run()
    except SystemExit as stop:
        if stop.code is None or isinstance(stop.code, int):  # tyro has printed help, or which option is wrong
            return stop.code or 0
        text = stop.code  # message of a program that ends itself, such as a user's driver
    except InputError as error:
        text = str(error)
    except OSError as error:
        if isinstance(error, BrokenPipeError) and _is_unread():  # else it is of an arm's connection
            raise
        why = f"{error.filename}: got {error.strerror!r}, expected a file or folder that can be used"
        text = why if error.filename else str(error)
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] not in TRAIN:
            raise
        text = missing(error, "train")
    except KeyboardInterrupt:
        return INTERRUPTED
    print(f"error: {text}", file=sys.stderr)
    return ERROR


def _is_unread() -> bool:
    """Return whether the output is a pipe whose reader has ended."""
    poll = select.poll()
    poll.register(STDOUT, 0)  # asks for errors alone
    return bool(poll.poll(0))


def _line(command: Command) -> str:
    """Return the first line of a command's docstring."""
    if isinstance(command, str):  # read from the file, because an import may take seconds
        module, _, name = command.partition(":")
        found: Any = importlib.util.find_spec(module)
        body = ast.parse(found.loader.get_source(module)).body
        defined = [node for node in body if isinstance(node, ast.FunctionDef | ast.ClassDef)]
        text = next(ast.get_docstring(node) for node in defined if node.name == name)
    else:
        text = inspect.getdoc(command)
    return (text or "").partition("\n")[0]


def parse(command: Any, prog: str, arguments: Sequence[str]) -> Callable[[], Any]:
    """Read the options of a command, a function or a dataclass, and return it with them, to be called.

    A dataclass may have a classmethod `default`, which makes the default options from the arguments.

    Raises:
        InputError: a dataclass refuses its values.
        SystemExit: tyro has printed help, or which option is wrong.
    """
    begin_with = {"default": command.default(arguments)} if hasattr(command, "default") else {}

    # Options of a function are bound without a call, so that a bug is not taken for a bad option.
    @functools.wraps(command, updated=())
    def bind(*args: Any, **options: Any) -> Callable[[], Any]:
        return functools.partial(command, *args, **options)

    kind = command if inspect.isclass(command) else bind
    # Settings may begin as true: both forms then stand beside the text, --x and --no-x. A function's flags
    # all begin as false, and need one form.
    flags = () if inspect.isclass(command) else (tyro.conf.FlagCreatePairsOff,)
    try:
        return tyro.cli(  # pyright: ignore[reportReturnType, reportCallIssue]
            kind, prog=prog, args=arguments, config=flags, **begin_with
        )
    except ValueError as error:
        raise InputError(str(error)) from error


def _integers(words: list[str]) -> tuple[int, ...]:
    numbers = words[0].split(",")
    if not all(number.isdecimal() for number in numbers):
        raise ValueError(f"got {words[0]!r}, expected whole numbers from 0 with commas between them")
    return tuple(sorted(set(map(int, numbers))))


def listed(read: Callable[[list[str]], tuple], metavar: str) -> PrimitiveConstructorSpec:
    """Return the reader of an option whose value is one word with commas."""
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=metavar,
        instance_from_str=read,
        is_instance=lambda value: isinstance(value, tuple),
        str_from_instance=lambda value: [",".join(map(str, value))],
    )


def one_of(names: Iterable[str]) -> PrimitiveConstructorSpec:
    """Return the reader of an option whose value is one of some names."""
    choices = tuple(names)
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=f"{{{','.join(choices)}}}",
        instance_from_str=lambda words: words[0],
        is_instance=lambda value: value in choices,
        str_from_instance=lambda value: [value],
        choices=choices,
    )


# Types of options.
MaybePath = tyro.conf.DisallowNone[Path | None]
Integers = Annotated[tuple[int, ...], listed(_integers, "N,N,...")]  # in rising order, each once
SpecFile = Annotated[
    MaybePath,
    tyro.conf.arg(
        metavar="ARM.toml|NAME",
        help="specification of the arm, or one of the package: paper, sopra, stiff-flop, four-chamber",
        help_behavior_hint="(default: the paper's arm)",
    ),
]
