"""INS aiding of channel loops: what is fed forward, and the clock drift that is learnt.

Without an estimate of its own an aided receiver feeds forward the first clock drift for ever.  The
drift is what the loops of all channels are left with in common: a share of the mean of the locked
ones' own Doppler moves to the clock, so that no command changes, and a channel that has lost lock
gets an aid that is right.  Common to all is a part of the INS's velocity error, too.
"""

from __future__ import annotations

import numpy as np

from signals.compiled import kernel
from ultratight.ins.imu import Increments
from ultratight.tracking.channel_state import LOCKED, WAVELENGTH_M, Loops
from ultratight.tracking.kalman_loop import DOPPLER
from ultratight.tracking.steering import advance_ins, predict, views

CLOCK_S = 1.0
"""Time constant with which the common Doppler moves to the clock"""
FEWEST_LOCKED = 4
"""Of fewer channels the mean may be anything's"""


class Delayed:
    """Increments on a line that holds them back by ``latency_s``."""

    def __init__(self, latency_s: float) -> None:
        self.latency_s = latency_s
        self._waiting: Increments | None = None

    def __call__(self, imu: Increments, t_s: float) -> Increments:
        """Put in what has ended by t_s; get what has arrived by then."""
        if self.latency_s == 0.0:
            return imu
        w = self._waiting
        if w is not None and w.alpha_ib_b.shape[0]:
            imu = Increments(
                np.concatenate([w.t_s, imu.t_s[1:]]),
                np.concatenate([w.alpha_ib_b, imu.alpha_ib_b]),
                np.concatenate([w.nu_ib_b, imu.nu_ib_b]),
            )
        n = int(np.searchsorted(imu.t_s[1:], t_s - self.latency_s + 1e-9, "right"))
        self._waiting = Increments(imu.t_s[n:], imu.alpha_ib_b[n:], imu.nu_ib_b[n:])
        return Increments(imu.t_s[: n + 1], imu.alpha_ib_b[:n], imu.nu_ib_b[:n])


# ---- kernels ---------------------------------------------------------------------------------


@kernel
def feed_forward(
    t_s: np.ndarray,
    alpha: np.ndarray,
    nu: np.ndarray,
    steering: np.ndarray,
    sky: np.ndarray,
    loops: Loops,
) -> None:
    """Take the increments (m, 3) between t_s (m + 1,) into the INS; renew what is fed forward.

    ``steering`` is the buffer of a `Steering`, ``sky`` its arcs.  The Doppler's rate is its change
    over the last interval.
    """
    s = views(steering, sky.shape[2])
    for j in range(t_s.size - 1):
        dt = t_s[j + 1] - t_s[j]
        advance_ins(s, alpha[j], nu[j], dt)
        predict(s, sky, t_s[j + 1])
        for i in range(loops.phase.size):
            doppler = -s.rho_rate[i] / WAVELENGTH_M
            loops.feed[i, 1] = (doppler - loops.feed[i, 0]) / dt
            loops.feed[i, 0] = doppler
    loops.feed_t_s[0] = t_s[t_s.size - 1]


@kernel
def learn_clock(steering: np.ndarray, share: float, loops: Loops) -> None:
    """Move a share of the locked channels' mean Doppler from their loops to the clock's drift."""
    n, total = 0, 0.0
    for i in range(loops.phase.size):
        if loops.phase[i] == LOCKED:
            n += 1
            total += loops.carrier_memory[i, 1]
    if n < FEWEST_LOCKED:
        return
    moved = share * total / n
    views(steering, loops.phase.size).clock[1] -= moved * WAVELENGTH_M
    for i in range(loops.phase.size):
        loops.feed[i, 0] += moved
        if loops.phase[i] == LOCKED:
            loops.loop_hz[i] -= moved
            loops.carrier_memory[i, 1] -= moved
            loops.last_good_hz[i] -= moved
            if loops.kalman.t_s.size:
                loops.kalman.mean[i, DOPPLER] -= moved
