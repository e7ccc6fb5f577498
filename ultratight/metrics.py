"""Figures of merit of a run: errors against truth, consistency, convergence, lock."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ultratight.ins.attitude import vector_from_rotation
from ultratight.results import Run

CONVERGED_MPS = 0.5
"""A run has converged when the r.m.s. velocity error of its end is below this"""
END_S = 2.5
SETTLED_S = 5.0
AFTER_S = 10.0
OFF_CARRIER_HZ, OFF_CARRIER_S = 25.0, 0.2
"""Frequency lock by the truth is lost by so much for so long: half the rate of data bits, as in the
comparison of Vilnrotter, Hinedi & Kumar (IEEE TAES 25(4), 1989)"""
OFF_CODE_CHIPS = 0.5
"""And code lock by so much"""
VELOCITY = slice(3, 6)
"""Where the velocity stands in the covariance of a run"""


def velocity_error(run: Run) -> np.ndarray:
    """True minus estimated velocity in ECEF (n_epoch, 3) [m/s]."""
    return run["v_eb_e_true"] - run["v_eb_e"]


def position_error(run: Run) -> np.ndarray:
    """True minus estimated position in ECEF (n_epoch, 3) [m]."""
    return run["r_eb_e_true"] - run["r_eb_e"]


def rms(error: np.ndarray, mask: np.ndarray) -> float | None:
    """Root mean square length of the rows (n, 3) under the mask; None if there are none."""
    if not mask.any():
        return None
    return float(np.sqrt(np.mean(np.sum(error[mask] ** 2, axis=1))))


def nees(error: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """Normalised estimation error squared (n,) of errors (n, d) with covariances (n, d, d)."""
    solved = np.linalg.solve(cov, error[..., None])[..., 0]
    return np.einsum("ni,ni->n", error, solved)


def nees_velocity(run: Run, mask: np.ndarray) -> float | None:
    """Median of NEES/3 of the velocity under the mask, None without covariance or epochs.

    It is relative to the expectation 3, not to the median of chi-square (2.37), hence 0.79 for a
    filter that is consistent.
    """
    if "covariance" not in run or not mask.any():
        return None
    cov = run["covariance"][mask][:, VELOCITY, VELOCITY]
    good = np.isfinite(cov).all(axis=(1, 2))
    if not good.any():
        return None
    return float(np.median(nees(velocity_error(run)[mask][good], cov[good]) / 3.0))


def error_state(run: Run, rows: np.ndarray) -> np.ndarray:
    """True minus estimated state (n, 17) of the given epochs, in the order of the covariance."""
    turn = run["C_b_e_true"][rows] @ np.swapaxes(run["C_b_e"][rows], 1, 2)
    psi = np.stack([vector_from_rotation(C) for C in turn])
    return np.column_stack(
        [
            position_error(run)[rows],
            velocity_error(run)[rows],
            psi,
            (run["accel_bias_true"] - run["accel_bias"])[rows],
            (run["gyro_bias_true"] - run["gyro_bias"])[rows],
            (run["clock_m_true"] - run["clock_m"])[rows],
            (run["clock_rate_true"] - run["clock_rate"])[rows],
        ]
    )


def nees_17(run: Run, times_s: Sequence[float]) -> np.ndarray:
    """NEES of all 17 states at the epochs nearest to the given times.

    It has the expectation 17 only where the IMU obeys the filter's model (grade "matched").
    """
    rows = np.abs(run.t_s[:, None] - np.asarray(times_s)).argmin(axis=0)
    return nees(error_state(run, rows), run["covariance"][rows][:, :17, :17])


def nis_per_measurement(run: Run, mask: np.ndarray) -> float | None:
    """Mean of NIS / m under the mask, over epochs with measurements."""
    if "nis" not in run:
        return None
    nis, m = run["nis"], run["n_measurement"]
    mask = mask & (m > 0) & np.isfinite(nis)
    return float(np.mean(nis[mask] / m[mask])) if mask.any() else None


def off_carrier_s(t_s: np.ndarray, error_hz: np.ndarray) -> np.ndarray:
    """When each NCO (n_channel,) began to be off the true carrier for `OFF_CARRIER_S` [s].

    error_hz (n_epoch, n_channel): its frequency error at times t_s (n_epoch,), NaN after the end
    of the receiver, which counts as off.  NaN where it never was.
    """
    return _began_s(t_s, _lasting(t_s, ~(np.abs(error_hz) <= OFF_CARRIER_HZ)))


def off_signal_s(
    t_s: np.ndarray, error_hz: np.ndarray, error_chips: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """When each replica (n_channel,) first was off its signal, and since when it no longer is [s].

    As `off_carrier_s`, where being off the code by more than `OFF_CODE_CHIPS` counts too.  The
    second is the time after the last loss, t_s[0] where there was none; NaN where it lasts.
    """
    off = ~((np.abs(error_hz) <= OFF_CARRIER_HZ) & (np.abs(error_chips) <= OFF_CODE_CHIPS))
    lasting = _lasting(t_s, off)
    last_off = lasting.shape[0] - 1 - lasting[::-1].argmax(axis=0)
    since = np.where(lasting.any(axis=0), last_off + 1, 0)
    there = since < t_s.size
    back = np.full(since.shape, np.nan)
    back[there] = t_s[since[there]]
    return _began_s(t_s, lasting), back


def _lasting(t_s: np.ndarray, off: np.ndarray) -> np.ndarray:
    """Rows (n_epoch, n_channel) of stretches of ``off`` that last `OFF_CARRIER_S` at least."""
    n = max(1, int(np.searchsorted(t_s - t_s[0], OFF_CARRIER_S - 1e-9))) if t_s.size else 1
    if t_s.size < n:
        return np.zeros(off.shape, bool)
    none = np.zeros((1, off.shape[1]), int)
    so_far = np.concatenate([none, np.cumsum(off, axis=0)])
    began = so_far[n:] - so_far[:-n] == n  # n rows from here on
    so_many = np.concatenate([none, np.cumsum(began, axis=0)])
    k = np.arange(off.shape[0])
    return so_many[np.minimum(k + 1, began.shape[0])] > so_many[np.maximum(k + 1 - n, 0)]


def _began_s(t_s: np.ndarray, lasting: np.ndarray) -> np.ndarray:
    out = np.full(lasting.shape[1], np.nan)
    found = lasting.any(axis=0)
    out[found] = t_s[lasting.argmax(axis=0)][found]
    return out


def chi2_interval(n: int, level: float = 0.95) -> tuple[float, float]:
    """Two-sided interval of chi-square with n degrees of freedom, divided by n."""
    tail = 0.5 * (1.0 - level)
    from scipy.special import gammaincinv  # slow to import; scipy.stats, a second

    # quantiles of chi-square
    low, high = (2.0 * gammaincinv(0.5 * n, p) / n for p in (tail, 1.0 - tail))
    return float(low), float(high)


def windows(t_s: np.ndarray, jump_s: tuple[float, float] | None) -> dict[str, np.ndarray]:
    """Masks {before, jump, after, end} over the epochs; a jump at 0 s leaves no `before`."""
    none = np.zeros(t_s.shape, dtype=bool)
    end = t_s > t_s[-1] - END_S
    if jump_s is None:
        return {"before": t_s > SETTLED_S, "jump": none, "after": none, "end": end}
    start, stop = jump_s
    return {
        "before": (t_s > SETTLED_S) & (t_s <= start),
        "jump": (t_s > start) & (t_s <= stop),
        "after": (t_s > stop) & (t_s <= stop + AFTER_S),
        "end": end,
    }


def summarise(run: Run, jump_s: tuple[float, float] | None) -> dict[str, Any]:
    """The figures that a run is judged by; None where one has no meaning."""
    masks = windows(run.t_s, jump_s)
    error = velocity_error(run)
    velocity = {name: _number(rms(error, mask)) for name, mask in masks.items()}
    end = velocity["end"]
    return {
        "converged": end is not None and end < CONVERGED_MPS,
        "velocity_rms_mps": velocity,
        "position_rms_end_m": _number(rms(position_error(run), masks["end"])),
        "nees_velocity": _number(nees_velocity(run, masks["jump"])),
        "nis_per_measurement": _number(nis_per_measurement(run, ~masks["jump"])),
    }


def _number(value: float | None) -> float | None:
    """None in place of NaN and inf, which JSON does not know."""
    return value if value is not None and np.isfinite(value) else None
