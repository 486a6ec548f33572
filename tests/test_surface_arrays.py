"""What is said of arrays of points by whole columns, as NumPy says it row by row."""

import numpy as np
import pytest

from clsurf.surface.arrays import box_of, extent_of, finite_rows, lengths_of, squared_lengths, used_numbers, whole_faces


@pytest.mark.parametrize("count", [1, 63, 64, 65, 1000])
@pytest.mark.parametrize("columns", [2, 3, 10])
def test_boxes_and_finite_rows_are_those_of_each_column(count, columns):
    """Rows are put together by 64 and columns looked at one by one: the answers are NumPy's own, bit by bit."""
    points = np.random.default_rng(count).normal(size=(count, columns)).astype(np.float32)
    for holes in (0, count // 10):
        points[np.random.default_rng(1).integers(0, count, holes), columns - 1] = np.nan
        low, high = box_of(points)
        assert low.dtype == np.float32 and np.array_equal(low, points.min(axis=0), equal_nan=True)
        assert np.array_equal(high, points.max(axis=0), equal_nan=True)
        assert np.array_equal(extent_of(points), np.ptp(points, axis=0), equal_nan=True)
        finite = finite_rows(points)
        assert np.array_equal(finite, np.isfinite(points).all(axis=1)) and finite.all() == (holes == 0)
        faces = np.random.default_rng(2).integers(0, count, (50, 3))
        assert np.array_equal(whole_faces(faces, finite), finite[faces].all(axis=1))
        assert np.array_equal(used_numbers(faces, count), np.unique(faces))
    if columns < 8:
        for vectors in (points, points.astype(np.float64), np.stack([points, -points])):
            assert np.array_equal(squared_lengths(vectors), (vectors ** 2).sum(axis=-1), equal_nan=True)
            for keepdims in (False, True):
                length = lengths_of(vectors, keepdims)
                assert np.array_equal(length, np.linalg.norm(vectors, axis=-1, keepdims=keepdims), equal_nan=True)
                assert length.dtype == vectors.dtype
