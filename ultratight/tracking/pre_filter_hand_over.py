"""What a pre-filter hands over: range and rate residual from the integrations since the last time.

Each integration j, at t_j before the hand-over at t, has measured c_j = r + n and p_j = p0 + n' of
one straight path r + v (t_j - t).  Weighted least squares in r, p0 and v gives

    z = (r, v) at t,     z = sum W_j (c_j, p_j)

with the phase p0 open in every interval.  That is all that the interval has learnt of range and
rate, and it holds nothing of the intervals before: not the filter's gains nor its prior, and no
phase carried on, whose error would be in two rates with opposite signs.  Noises of two hand-overs
are independent, and the central filter may take them for white.

Because z is linear in what was measured, what it says of the central filter's state x follows
exactly, whatever the path was.  With A0 the row of the range, A1 of its rate and A2 of its
acceleration (`measurements.range_rows`),

    z = (sum W_c) A0 x + (sum W (t_j - t)) A1 x + (sum W (t_j - t)^2 / 2) A2 x + clock + noise,

where least squares makes the first two factors (1, 0) for r and (0, 1) for v.

The clock's noises since t_j are in the state at t, and not in what was measured at t_j: with B the
white frequency noise and G the drift's,

    e_j = -int dB + int (s - t_j) dG(s),   s from t_j to t.

They are common to all channels, but for each one's bit edges.  The central filter has one state
more, ``step``: e seen by the rate of ten integrations that fill the epoch.  It is correlated with
what B and G did to clock bias and drift, is new in every epoch and is forgotten.  A hand-over holds
its regression on that, and the rest of sum W_j e_j is noise of the channel's own.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from signals.compiled import kernel
from ultratight.ins.error_state import CB, CD
from ultratight.tracking.measurements import range_rows
from ultratight.tracking.pre_filter import (
    CODE_M,
    CODE_VARIANCE,
    PHASE_M,
    PHASE_VARIANCE,
    T_S,
    PreFilters,
)
from ultratight.tracking.steering import views

N_NOMINAL = 10


class ClockStep(NamedTuple):
    """The state ``step`` of an epoch: how it is made, and its moments."""

    ago_s: np.ndarray  # (N_NOMINAL,) of the integrations before the end of the epoch
    weight: np.ndarray  # (N_NOMINAL,) of each in the rate [1/s]
    density: np.ndarray  # (2,) S_f [m2/s], S_g [m2/s3]
    variance: float  # [m2/s2]
    with_bias: float  # covariance with what the epoch did to the clock bias [m2/s]
    with_drift: float  # [m2/s2]


def clock_step(epoch_s: float, clock_sf: float, clock_sg: float) -> ClockStep:
    """Of epochs of ``epoch_s`` seconds and the clock's densities [m2/s, m2/s3]."""
    ago = (np.arange(N_NOMINAL) + 0.5) * epoch_s / N_NOMINAL
    away = ago.mean() - ago
    weight, density = away / (away @ away), np.array([clock_sf, clock_sg])
    cov = np.array([[clock_cov(a, b, density) for b in ago] for a in ago])
    return ClockStep(
        ago, weight, density, float(weight @ cov @ weight),
        float(weight @ (clock_sg * ago**3 / 6.0 - clock_sf * ago)),
        float(weight @ (clock_sg * ago**2 / 2.0)),
    )  # fmt: skip


# ---- kernels ---------------------------------------------------------------------------------


@kernel
def clock_cov(a: float, b: float, density: np.ndarray) -> float:
    """Covariance of e a and b seconds before the hand-over [m2]."""
    m = min(a, b)
    return density[0] * m + density[1] * m * (a * b - 0.5 * m * (a + b) + m * m / 3.0)


@kernel
def clock_step_into(T: float, step: ClockStep, Phi: np.ndarray, Q: np.ndarray) -> None:
    """Rows and columns of the step, the last state, in Phi and Q of an epoch of T seconds.

    Of the clock's states Q becomes exact: the trapezium's T^3 / 2 of the drift's noise is T^3 / 3.
    """
    w = Phi.shape[0] - 1
    for i in range(w + 1):
        Phi[i, w], Phi[w, i], Q[i, w], Q[w, i] = 0.0, 0.0, 0.0, 0.0
    Q[CB, CB] -= step.density[1] * T**3 / 6.0
    Q[CB, w], Q[w, CB] = step.with_bias, step.with_bias
    Q[CD, w], Q[w, CD] = step.with_drift, step.with_drift
    Q[w, w] = step.variance


@kernel
def hand_over(
    t_s: float,
    buffer: np.ndarray,
    n_scale: int,
    step: ClockStep,
    use: np.ndarray,
    pre: PreFilters,
    z: np.ndarray,
    A: np.ndarray,
    R: np.ndarray,
    channel: np.ndarray,
) -> int:
    """Range and rate residual of every channel in ``use`` (n_channel,); what was kept is forgotten.

    Into z (n, 2) [m, m/s], A (n, 2, n_state), R (n, 2, 2), channel (n,); returns how many.
    """
    n_channel = pre.t_s.size
    s = views(buffer, n_channel)
    n_state, nb = A.shape[2], 0
    now, later = np.empty((2, n_state)), np.empty((2, n_state))
    for i in range(n_channel):
        n = pre.n_kept[i]
        pre.n_kept[i] = 0
        if n < 2 or not use[i]:
            continue
        kept = pre.kept[i, :n]
        W = np.empty((2, 2, n))
        fit_path(t_s, kept, W, R[nb])
        range_rows(s, i, 0.0, n_scale, now)
        range_rows(s, i, 1.0, n_scale, later)
        for o in range(2):
            z[nb, o], bent = 0.0, 0.0
            for j in range(n):
                both = W[o, 0, j] + W[o, 1, j]
                z[nb, o] += W[o, 0, j] * kept[j, CODE_M] + W[o, 1, j] * kept[j, PHASE_M]
                bent += 0.5 * both * (kept[j, T_S] - t_s) ** 2
            for m in range(n_state):
                A[nb, o, m] = now[o, m] + bent * (later[1, m] - now[1, m])
        _clock_of(t_s, kept, W, step, A[nb], R[nb])
        channel[nb] = i
        nb += 1
    return nb


@kernel
def error_variances(buffer: np.ndarray, n_scale: int, cov: np.ndarray, found: np.ndarray) -> None:
    """Variances (n_channel, 3) of range, rate and acceleration along the line of sight."""
    n_channel, n = found.shape[0], cov.shape[0]
    s = views(buffer, n_channel)
    now, later, row = np.empty((2, n)), np.empty((2, n)), np.empty(n)
    for i in range(n_channel):
        range_rows(s, i, 0.0, n_scale, now)
        range_rows(s, i, 1.0, n_scale, later)
        for o in range(3):
            for a in range(n):
                row[a] = now[o, a] if o < 2 else later[1, a] - now[1, a]
            total = 0.0
            for a in range(n):
                if row[a] != 0.0:
                    for b in range(n):
                        total += row[a] * row[b] * cov[a, b]
            found[i, o] = max(total, 0.0)


@kernel
def fit_path(t_s: float, kept: np.ndarray, W: np.ndarray, cov: np.ndarray) -> None:
    """Weights W (2, 2, n), of code and phase in r and v at t_s, and their covariance (2, 2)."""
    n = kept.shape[0]
    c0, c1, c2, p0, p1, p2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for j in range(n):
        t = kept[j, T_S] - t_s
        code, phase = 1.0 / kept[j, CODE_VARIANCE], 1.0 / kept[j, PHASE_VARIANCE]
        c0 += code
        c1 += code * t
        c2 += code * t * t
        p0 += phase
        p1 += phase * t
        p2 += phase * t * t
    # information of r and v, the phase p0 eliminated
    rate = c2 + p2 - p1 * p1 / p0
    det = c0 * rate - c1 * c1
    cov[0, 0], cov[1, 1] = rate / det, c0 / det
    cov[0, 1], cov[1, 0] = -c1 / det, -c1 / det
    for j in range(n):
        t = kept[j, T_S] - t_s
        code, phase = 1.0 / kept[j, CODE_VARIANCE], 1.0 / kept[j, PHASE_VARIANCE]
        for o in range(2):
            W[o, 0, j] = (cov[o, 0] + cov[o, 1] * t) * code
            W[o, 1, j] = cov[o, 1] * (t - p1 / p0) * phase


@kernel
def _clock_of(
    t_s: float, kept: np.ndarray, W: np.ndarray, step: ClockStep, A: np.ndarray, R: np.ndarray
) -> None:
    """Put the clock's noises since the integrations into A (2, n_state), last state, and R."""
    n, last = kept.shape[0], A.shape[1] - 1
    own, common = np.zeros((2, 2)), np.zeros(2)
    for j in range(n):
        ago = t_s - kept[j, T_S]
        for m in range(n):
            cov = clock_cov(ago, t_s - kept[m, T_S], step.density)
            for o in range(2):
                for p in range(2):
                    both = W[p, 0, m] + W[p, 1, m]
                    own[o, p] += (W[o, 0, j] + W[o, 1, j]) * both * cov
        for m in range(step.ago_s.size):
            cov = step.weight[m] * clock_cov(ago, step.ago_s[m], step.density)
            for o in range(2):
                common[o] += (W[o, 0, j] + W[o, 1, j]) * cov
    for o in range(2):
        A[o, last] = common[o] / step.variance if step.variance > 0.0 else 0.0
    for o in range(2):
        for p in range(2):
            R[o, p] += own[o, p] - A[o, last] * common[p]
