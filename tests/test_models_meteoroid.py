"""The meteoroid: a closed rock, the same from the same seed."""

import numpy as np
import pytest

from clsurf.errors import InputError
from clsurf.models import meteoroid
from clsurf.models.meteoroid import crater_field, icosphere


@pytest.mark.parametrize("parts", (1, 2, 7))
def test_icosphere_is_closed_and_faces_outward(parts):
    points, faces = icosphere(parts)
    assert len(faces) == 20 * parts**2 and len(points) == 10 * parts**2 + 2
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    assert len(np.unique(edges, axis=0)) == len(edges)  # every edge once each way
    assert {tuple(e) for e in edges} == {tuple(e[::-1]) for e in edges}
    corners = points[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((normals * corners[:, 0]).sum(axis=1) > 0).all()
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1)


def test_the_same_seed_gives_the_same_rock_at_every_resolution():
    a, b, other = meteoroid(5, 20 * 16**2), meteoroid(5, 20 * 32**2), meteoroid(6, 20 * 16**2)
    fine = {tuple(np.round(p, 4)) for p in b.vertices.tolist()}
    shared = sum(tuple(np.round(p, 4)) in fine for p in a.vertices.tolist())
    assert shared > 0.99 * len(a.vertices)  # every other vertex
    assert np.abs(a.vertices - other.vertices).max() > 0.05
    np.testing.assert_array_equal(meteoroid(5, 20 * 16**2).vertices, a.vertices)
    np.testing.assert_allclose(meteoroid(5, 20 * 16**2, radius=3.0).vertices, 3 * a.vertices, rtol=1e-5)
    assert ((a.normals * a.vertices).sum(axis=1) > 0).mean() > 0.98
    length = np.linalg.norm(a.vertices, axis=1)
    assert 0.3 < length.min() < 0.9 < length.max() < 1.7


def test_a_crater_is_a_bowl_with_a_rim():
    directions, _ = icosphere(60)

    class One:
        def uniform(self, low, high, count):
            return np.full(count, high)

        def normal(self, size):
            return np.array([0, 0, 2.0])

    height = crater_field(directions, 1, One())
    angle = np.arccos(directions[:, 2])
    assert np.argmin(height) == np.argmin(angle) and height.min() < -0.1
    assert abs(angle[np.argmax(height)] - 0.48) < 0.05 and height.max() > 0.02
    assert (height[angle > 1.1] == 0).all()


@pytest.mark.parametrize("options", [dict(faces=3), dict(faces=1.5), dict(craters=-1), dict(radius=0),
                                     dict(radius="a")])
def test_wrong_options_are_refused(options):
    with pytest.raises(InputError, match="expected"):
        meteoroid(**options)
