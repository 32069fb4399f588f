"""The graphs in onnxruntime's build for browsers, run by node."""

import json
import os
import shutil
import subprocess

import numpy as np
import pytest

from mjx_softarm.deploy.safety import Fault
from mjx_softarm.export.check import TOLERANCE, compare, without_memory
from mjx_softarm.export.golden import BITS, FLAGS, N_SINGLE
from mjx_softarm.export.write import export_onnx
from tests.export.conftest import few_golden_rows

pytest.importorskip("onnx", reason="the package onnx is not installed")
SCRIPT = """
const ort = require("onnxruntime-web");
ort.env.logLevel = "error";
const numbers = (list) => new ort.Tensor("float32", list.map((x) => x ?? NaN), [list.length]);
(async () => {
  const [path, rows] = JSON.parse(require("fs").readFileSync(0, "utf8"));
  const session = await ort.InferenceSession.create(path);
  for (const row of rows) {
    const feeds = Object.fromEntries(Object.entries(row).map(([name, list]) => [name, numbers(list)]));
    const found = Object.entries(await session.run(feeds)).map(([name, x]) => [name, Array.from(x.data)]);
    console.log(JSON.stringify(Object.fromEntries(found)));
  }
})();
"""


def in_node(script, text=""):
    """Output of a script, with packages from NODE_PATH or ./node_modules; None if it fails."""
    if not shutil.which("node"):
        return None
    paths = os.pathsep.join(filter(None, [os.environ.get("NODE_PATH"), os.path.abspath("node_modules")]))
    command, env = ["node", "-e", script], os.environ | {"NODE_PATH": paths}
    done = subprocess.run(command, input=text, capture_output=True, text=True, env=env)
    return done.stdout if done.returncode == 0 else None


pytestmark = pytest.mark.skipif(
    in_node('require.resolve("onnxruntime-web")') is None,
    reason="there is no node with onnxruntime-web here: npm install onnxruntime-web",
)


@pytest.fixture(scope="module")
def files(policy_file):
    with few_golden_rows():
        return export_onnx(policy_file)


def answers(path, rows):
    def listed(values):
        return [float(x) if np.isfinite(x) else None for x in values]

    table = [{name: listed(values) for name, values in row.items()} for row in rows]
    lines = in_node(SCRIPT, json.dumps([str(path), table])).splitlines()
    assert len(lines) == len(rows)
    return [{name: np.array(x, float).squeeze() for name, x in json.loads(line).items()} for line in lines]


def test_policy_agrees_on_golden_rows(files, golden):
    restart, checked = (golden.inputs[:, FLAGS.index(name)] for name in ("restart", "checked"))
    single = golden.inputs[restart > checked]
    rows = [{"readings": row[len(FLAGS) : -6], "goal": row[-6:]} for row in single]
    found = iter(answers(files[0], rows))
    agreement = compare(golden, *without_memory(golden, lambda *_: next(found)))
    assert agreement.n_rows >= N_SINGLE and agreement.error < TOLERANCE, agreement


def test_check_of_goals_agrees(files, golden):
    rows = np.flatnonzero(golden.inputs[:, FLAGS.index("checked")])
    found = answers(files[2], [{"goal": goal} for goal in golden.inputs[rows, -6:]])
    refused = golden.outputs[rows, 0].astype(int) & BITS[Fault.GOAL_OUTSIDE] > 0
    assert len(rows) > 20
    np.testing.assert_array_equal([row["goal_outside"] for row in found], refused)
