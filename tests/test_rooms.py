"""Imports between the rooms run one way, as the files' import statements and fresh processes show."""

import ast
import graphlib
import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
# Rooms of a level may import those of the levels before, and others of their own level without a circle.
LEVELS = (
    ("_support",),
    ("sensing", "arms"),
    ("spec", "pneumatics"),
    ("mechanics", "control", "logs", "posture"),
    ("mdp",),
    ("env", "policy"),
    ("deploy",),
    ("twin",),
    ("export",),
    ("view",),
    ("__init__", "__main__"),
    ("calib",),
    ("train",),
    ("benchmarks",),
)
LEVEL = {room: level for level, rooms in enumerate(LEVELS) for room in rooms}
JOBS = ("calib", "train", "benchmarks")
HEAVY = {"jax", "jaxlib", "mujoco"}
# Functions that need JAX import it where they are called; the room itself is imported without.
LIGHT = ("export", "deploy", "policy", "sensing", "mdp", "logs", "view")


def imported(tree):
    """Every name that a file imports anywhere in it: modules, and what is taken from them."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{ast.unparse(node)}: expected the name of the room"
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def room_of(name):
    """The room of a module or of a path's parts, or None for a library."""
    top, *below = name.split(".")
    if top == "mjx_softarm":
        return below[0] if below and below[0] in LEVEL else None
    return top if top in JOBS else None


def module_of(path):
    return ".".join(path.relative_to(ROOT).with_suffix("").parts)


# Room, path and syntax tree of every file of the product and of the benchmarks
FILES = [path for top in ("mjx_softarm", *JOBS) for path in sorted((ROOT / top).rglob("*.py"))]
TREES = [(room_of(module_of(path)), path, ast.parse(path.read_text("utf-8"))) for path in FILES]
ARROWS = [
    (room, other, path) for room, path, tree in TREES for name in imported(tree) if (other := room_of(name))
]


def test_every_file_stands_in_a_room():
    assert not [path for room, path, _ in TREES if room is None]
    assert len(ARROWS) > 300


def test_imports_run_one_way():
    assert not {(path, other) for room, other, path in ARROWS if LEVEL[other] > LEVEL[room]}
    # Rooms of one level make no circle
    graph = {room: {b for a, b, _ in ARROWS if a == room and b != room} for room in LEVEL}
    assert set(graphlib.TopologicalSorter(graph).static_order()) >= set(LEVEL)


def test_no_circle_between_files():
    """Imports in functions and imports for types count, too."""
    taken = {module_of(path).removesuffix(".__init__"): imported(tree) for _, path, tree in TREES}
    graph = {name: (set(found) & taken.keys()) - {name} for name, found in taken.items()}
    assert sum(map(len, graph.values())) > 200
    assert len(list(graphlib.TopologicalSorter(graph).static_order())) == len(graph)


def test_nothing_imports_the_view():
    assert {room for room, other, _ in ARROWS if other == "view"} == {"view"}


@pytest.mark.parametrize("room", ["train", "calib"])
def test_training_and_calibration_never_import_the_twin(room):
    assert "twin" not in {other for top, other, _ in ARROWS if top == room}
    # Nor is it imported by a string
    assert not [path for top, path, _ in TREES if top == room and "softarm.twin" in path.read_text("utf-8")]


@pytest.mark.parametrize("room", LIGHT)
def test_light_rooms_name_no_simulator(room):
    names = {(path, name) for top, path, tree in TREES if top == room for name in imported(tree)}
    assert names and not {(path, name) for path, name in names if name.split(".")[0] in HEAVY}


LOADED = """
import importlib, pkgutil, sys
for name in sys.argv[1:]:
    package = importlib.import_module(name)
    for module in pkgutil.walk_packages(package.__path__, name + "."):
        importlib.import_module(module.name)
print(*sorted(sys.modules))
"""


def test_light_rooms_are_imported_without_jax_and_mujoco():
    """All of their modules, in a fresh process."""
    rooms = [room for room in LIGHT if room != "view" or importlib.util.find_spec("viser")]
    command = [sys.executable, "-c", LOADED, *(f"mjx_softarm.{room}" for room in rooms)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    modules = set(done.stdout.split())
    assert not modules & {*HEAVY, *JOBS} and "mjx_softarm.deploy.session" in modules
