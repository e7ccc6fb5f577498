"""The world of an IF file: satellites rise and set.

Satellites are those with a healthy set of ephemerides at the start.  Each is received while it
is at or above the mask, which is looked at once per window; one that rises later is in the file
from then on.  A set serves until 2 h from its toe: a longer file is refused.
"""

from __future__ import annotations

import math

import numpy as np

from ultratight import sky
from ultratight.config import InvalidInput
from ultratight.scenario import Scenario
from ultratight.world import World

WINDOW_S = 1.0
_LOOK_S = 30.0


class FileWorld(World):
    """The truth of a scenario and a seed; see the module."""

    def _choose_satellites(self) -> None:
        s = self.scenario
        if s.signals != ("L1CA",):
            raise InvalidInput(
                f"signals: {', '.join(s.signals)} given, expected L1CA: files hold no other yet"
            )
        self.sky = sky.constellation(s)
        t = np.unique(np.append(np.arange(0.0, s.duration_s, _LOOK_S), s.duration_s))
        seen = {p: self._highest(p, t) for p in self.sky.prn.tolist() if _wanted(s, p)}
        up = {p: e for p, e in seen.items() if e >= s.mask_deg}
        order = sorted(up, key=lambda p: (-up[p], p))[: s.max_satellites]
        if not order:
            raise InvalidInput(
                f"mask_deg: no satellite of {s.constellation} at or above {s.mask_deg:g} deg at "
                f"any time{sky.other_sky(s)}"
            )
        self.prn = np.array(sorted(order))
        self._check_ages()
        prn, rows = self.sky.select(s.start_week, s.start_tow_s)
        self._name_channels(self.prn, rows[np.searchsorted(prn, self.prn)])

    def _highest(self, prn: int, t_s: np.ndarray) -> float:
        """Highest elevation [deg] at those of the times at which the set of the start serves."""
        t = t_s[t_s < sky.valid_until_s(self.sky, prn, self.scenario)]
        return float(np.degrees(self.look(prn, t)[0].max())) if t.size else -90.0

    def _check_ages(self) -> None:
        s = self.scenario
        until = {p: sky.valid_until_s(self.sky, p, s) for p in self.prn.tolist()}
        first = min(until, key=lambda p: until[p])
        if until[first] < s.duration_s + 2.0 * WINDOW_S:
            most = math.floor(until[first] - 2.0 * WINDOW_S)
            raise InvalidInput(
                f"duration_s: {s.duration_s:g} given, expected at most {most}: the ephemeris of "
                f"G{first:02d} at the start is then 2 h from its toe"
            )

    def look(self, prn: int, t_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Elevation and azimuth (n,) [rad] of a satellite at receiver times (n,)."""
        s, r = self.scenario, self.antenna(t_s)[0]
        return sky.look(self.sky, prn, s.start_week, s.start_tow_s + self.true_time(t_s), r)

    def look_all(self, t_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Elevation and azimuth (n, n_channel) [rad] of the channels."""
        both = [self.look(p, t_s) for p in self.prn.tolist()]
        return np.stack([b[0] for b in both], axis=1), np.stack([b[1] for b in both], axis=1)


def _wanted(s: Scenario, prn: int) -> bool:
    return s.prns is None or prn in s.prns
