"""A filter of one's own: its velocity walks while the innovations are too large."""

import numpy as np

from ultratight import statistics, sweep
from ultratight.filters.catalog import CATALOG, RecipeFilter


class Adaptive(RecipeFilter):
    excess = 0.0

    def step(self, state, prediction, measurement):
        q, v, n = prediction.q.copy(), prediction.layout.v, max(1, measurement.z.size)
        q[v, v] += min(1.0, self.excess) * 0.1**2 * prediction.T * np.eye(3)
        result = super().step(state, prediction._replace(q=q), measurement)
        self.excess = max(0.98 * self.excess, result.nis / n / 1.5 - 1.0)
        return result


own = {"mine": lambda: Adaptive(CATALOG["qkf"])}
data = sweep("jump-1", {"receiver.filter": ["qkf", "fiqkf-r", *own]}, runs=20, filters=own)
jump = data.velocity_rms_mps.sel(window="jump")
for name in "qkf", "fiqkf-r":
    difference = statistics.paired_difference(jump.sel(filter="mine"), jump.sel(filter=name))
    print(f"mine - {name}: {difference} m/s, median of {difference.n} pairs")
