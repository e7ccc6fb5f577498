"""What the path and the satellites' clocks do for a time: C/N0 that changes, faulty pseudoranges.

A satellite whose clock is at fault sends everything late, code, data and carrier alike, so that

    code_phase_chips     falls by  delay f_chip / c,
    carrier_phase_cycles falls by  delay f / c.

The satellite's own way in the extra delay, less than 0.02 um per metre of it, is left out.  What
reshapes the code's correlation or raises the noise (multipath, jamming) is no such thing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from signals.code_start import Nominal
from signals.constants import C_MPS
from signals.propagation import SignalState


class Disturbance(NamedTuple):
    """Changes from t0_s on and before t1_s; the delay is delay_m + delay_rate_mps (t - t0_s)."""

    t0_s: float
    t1_s: float  # inf: to the end
    affected: np.ndarray  # (n_channel,) bool
    cn0_change_db: float = 0.0
    delay_m: float = 0.0
    delay_rate_mps: float = 0.0


class Effects(NamedTuple):
    """The sum of all disturbances, (n_channel, n) each."""

    cn0_change_db: np.ndarray
    delay_m: np.ndarray
    delay_rate_mps: np.ndarray


def effects(
    disturbances: Sequence[Disturbance],
    t_s: np.ndarray,
    n_channel: int,
    judged_s: np.ndarray | None = None,
) -> Effects:
    """What the disturbances do at times t_s (n,), receiver time since the start.

    ``judged_s`` (n,): times that say which ones are under way, where they are not t_s themselves.

    Raises
    ------
    ValueError
        A number that is not finite (but for t1_s), an end that is not after the begin, or
        ``affected`` of another shape.
    """
    t_s = np.asarray(t_s, dtype=np.float64)
    judged_s = t_s if judged_s is None else np.asarray(judged_s, dtype=np.float64)
    sums = Effects(*(np.zeros((n_channel, t_s.size)) for _ in Effects._fields))
    for d in disturbances:
        _check(d, n_channel)
        under_way = (judged_s >= d.t0_s) & (judged_s < d.t1_s)
        where = d.affected[:, None] & under_way
        sums.cn0_change_db[:] += where * d.cn0_change_db
        sums.delay_m[:] += where * (d.delay_m + d.delay_rate_mps * (t_s - d.t0_s))
        sums.delay_rate_mps[:] += where * d.delay_rate_mps
    return sums


def disturbed(state: SignalState, disturbances: Sequence[Disturbance], of: Nominal) -> SignalState:
    """The truth at the antenna with its disturbances; each begins and ends at the nearest node.

    Parameters
    ----------
    state : truth without them.
    disturbances : any number; those that overlap add up.
    of : carrier and chip rate of each channel.

    Raises
    ------
    ValueError
        As `effects`.
    """
    if not disturbances:
        return state
    start = state.t_s[:-1]
    found = effects(disturbances, start, len(state.valid), 0.5 * (start + state.t_s[1:]))
    code, carrier = state.code_phase_chips.copy(), state.carrier_phase_cycles.copy()
    for phase, hz in ((code, of.chip_rate_hz), (carrier, of.carrier_hz)):
        per_m = (hz / C_MPS)[:, None]
        phase[..., 0] -= per_m * found.delay_m
        phase[..., 1] -= per_m * found.delay_rate_mps
    return state._replace(
        code_phase_chips=code,
        carrier_phase_cycles=carrier,
        cn0_dbhz=state.cn0_dbhz + found.cn0_change_db,
    )


def _check(d: Disturbance, n_channel: int) -> None:
    numbers = (d.t0_s, d.cn0_change_db, d.delay_m, d.delay_rate_mps)
    if not all(map(math.isfinite, numbers)):
        raise ValueError(f"disturbance {numbers}: expected finite numbers")
    if not d.t1_s > d.t0_s:
        raise ValueError(f"t1_s: {d.t1_s}, expected more than t0_s = {d.t0_s}")
    if d.affected.shape != (n_channel,) or d.affected.dtype != np.bool_:
        raise ValueError(
            f"affected: {d.affected.dtype} {d.affected.shape}, expected bool ({n_channel},)"
        )
