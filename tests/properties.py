"""Hypothesis for this project: always the same few examples, no time limit, nothing stored."""

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

few = settings(
    max_examples=25,
    derandomize=True,
    deadline=None,
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


@st.composite
def damaged(draw, data: bytes):
    """Bytes that differ from `data`: cut, with a byte changed, or with some put in."""
    at = draw(st.integers(0, len(data) - 1))
    kind = draw(st.sampled_from(("cut", "change", "insert")))
    if kind == "cut":
        return data[:at]
    if kind == "change":
        return data[:at] + bytes([data[at] ^ draw(st.integers(1, 255))]) + data[at + 1 :]
    return data[:at] + draw(st.binary(min_size=1, max_size=40)) + data[at:]
