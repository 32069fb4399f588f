"""Sealed files: any arrays are written and read again, and a changed file is never read."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from mjx_softarm._support.archive import SealedFileError, read_sealed, sealed, write_sealed
from tests.properties import damaged, few

DTYPES = st.sampled_from(("f4", "f8", "i4", "i8", "U5", "?")).map(np.dtype)
ARRAYS = st.dictionaries(
    st.text("abc.01", min_size=1, max_size=8),
    DTYPES.flatmap(lambda dtype: npst.arrays(dtype, npst.array_shapes(min_dims=0, max_dims=3, min_side=0))),
    max_size=4,
)
SEALED = sealed({"weight": np.arange(12.0).reshape(3, 4), "name": np.array("arm")}, "test")


@few
@given(arrays=ARRAYS)
def test_arrays_are_written_and_read_again(tmp_path, arrays):
    write_sealed(tmp_path / "file.npz", arrays, "test")
    again = read_sealed(tmp_path / "file.npz", "test", "a test")
    assert again.keys() == arrays.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(again[name], array, strict=True)


@settings(few, max_examples=200)
@given(data=damaged(SEALED))
def test_damaged_bytes_are_refused(tmp_path, data):
    (tmp_path / "file.npz").write_bytes(data)
    with pytest.raises(SealedFileError, match=r"file\.npz: "):
        read_sealed(tmp_path / "file.npz", "test", "a test")
