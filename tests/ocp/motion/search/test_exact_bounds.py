"""The bound of the least length of a step into a curve is the minimum on a grid."""

from __future__ import annotations

import numpy as np

from ocp.motion.search.charts import Charts
from ocp.motion.search.lengths import Homogeneous, PathLength
from ocp.motion.search.steps import QuadraticBounds


def test_least_length_of_steps_into_curves_is_that_on_a_grid() -> None:
    rng, count, n = np.random.default_rng(40), 300, 7
    tangents = rng.normal(size=(count, n, 1))
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    tangents[:20, 3] = 0.0
    low, high = -rng.uniform(0, 0.1, (count, 1)), rng.uniform(0, 0.1, (count, 1))
    low[:10] = high[:10] = 0.0
    layer, deviations = np.zeros(count, dtype=np.intp), np.zeros((count, 2, n))
    target = Charts(layer, np.zeros((count, n)), tangents, np.full(count, 0.1), low, high, deviations)
    delta = 0.05 * rng.normal(size=(count, n))
    after = QuadraticBounds(rng.normal(size=count), rng.normal(size=(count, 1)), np.zeros((count, 1, 1)))
    cost = PathLength(np.append(rng.uniform(0.5, 2.0, n - 1), 0.0))
    least, multipliers, places = cost.minimize(delta, target, after)
    grid = low + (high - low) * np.linspace(0, 1, 1001)
    values = cost.evaluate(delta[:, None] + tangents[:, None, :, 0] * grid[:, :, None], 1.0) + after.slope * grid
    values += after.least[:, None]
    assert (least <= values.min(axis=1) + 1e-12).all()
    at_places = cost.evaluate(delta + tangents[:, :, 0] * places, 1.0) + (after.slope * places)[:, 0] + after.least
    np.testing.assert_allclose(least, at_places, atol=1e-12)
    assert (np.abs(multipliers) <= cost.weights + 1e-12).all()
    assert (least >= Homogeneous.minimize(cost, delta, target, after)[0] - 1e-12).all()
