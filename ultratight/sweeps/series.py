"""What can be kept of a run over time: one number per row of its history."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ultratight import config, metrics
from ultratight.ins.attitude import vector_from_rotation
from ultratight.results import Run

_SLACK_S = 1e-6


class Series(NamedTuple):
    """How a series is found, and what it is."""

    of: Callable[[Run], np.ndarray]  # (n_epoch,)
    units: str
    long_name: str


def _length(vectors: np.ndarray) -> np.ndarray:
    return np.sqrt(np.sum(vectors**2, axis=1))


def _along(run: Run) -> np.ndarray:
    """The part of the velocity error along the forward axis."""
    return np.einsum("ni,ni->n", metrics.velocity_error(run), run["C_b_e_true"][:, :, 0])


def _attitude(run: Run) -> np.ndarray:
    turn = run["C_b_e_true"] @ np.swapaxes(run["C_b_e"], 1, 2)
    out = np.full(run.t_s.size, np.nan)
    for k in np.flatnonzero(np.isfinite(turn).all(axis=(1, 2))):
        out[k] = 1e3 * np.linalg.norm(vector_from_rotation(turn[k]))
    return out


def _sigma(first: int) -> Callable[[Run], np.ndarray]:
    block = np.arange(first, first + 3)
    return lambda run: np.sqrt(run["covariance"][:, block, block].sum(axis=1))


def _nis(run: Run) -> np.ndarray:
    n = run["n_measurement"]
    return np.divide(run["nis"], n, out=np.full(n.shape, np.nan), where=n > 0)


SERIES = {
    "velocity_error": Series(
        lambda run: _length(metrics.velocity_error(run)), "m/s", "length of the velocity error"
    ),
    "velocity_error_forward": Series(
        _along, "m/s", "velocity error along the forward axis, true minus estimate"
    ),
    "position_error": Series(
        lambda run: _length(metrics.position_error(run)), "m", "length of the position error"
    ),
    "attitude_error": Series(_attitude, "mrad", "length of the attitude error"),
    "velocity_sigma": Series(_sigma(3), "m/s", "root of the trace of the velocity covariance"),
    "position_sigma": Series(_sigma(0), "m", "root of the trace of the position covariance"),
    "clock_error": Series(
        lambda run: run["clock_m_true"] - run["clock_m"], "m", "clock error, true minus estimate"
    ),
    "nis": Series(_nis, "1", "NIS per measured number"),
    "fading_factor": Series(lambda run: run["fading_factor"], "1", "fading factor"),
    "lock_indicator": Series(
        lambda run: run["lock_indicator"].mean(axis=1), "1", "lock indicator, mean over channels"
    ),
    "cn0": Series(lambda run: run["cn0"].mean(axis=1), "dB-Hz", "estimated C/N0, mean of channels"),
    "speed_true": Series(lambda run: run["speed_true"], "m/s", "true speed over the Earth"),
}  # fmt: skip
"""Name -> series; what a closure does not have is NaN"""


def check(names: Sequence[str], every_s: float, longest_s: float) -> None:
    """`InvalidInput` for a name that is none or stands twice, or a spacing that cannot be.

    longest_s: the longest run.
    """
    if isinstance(names, str):
        raise config.InvalidInput(f"keep: {names!r} given, expected a list of names")
    for i, name in enumerate(names):
        if name not in SERIES:
            raise config.InvalidInput(f"keep: {name!r} given, expected one of {', '.join(SERIES)}")
        if name in names[:i]:
            raise config.InvalidInput(f"keep: {name!r} given twice, expected once")
    if not isinstance(every_s, int | float) or not 1e-3 <= every_s < np.inf:
        raise config.InvalidInput(f"every_s: {every_s} given, expected 0.001 s or more")
    if names and times(longest_s, every_s).size == 0:
        raise config.InvalidInput(
            f"every_s: {every_s} given, expected no more than the {longest_s:g} s of a run"
        )


def times(duration_s: float, every_s: float) -> np.ndarray:
    """When a series is kept: every_s, 2 every_s, ... up to the end."""
    return every_s * np.arange(1, int(duration_s / every_s + _SLACK_S) + 1)


def series(run: Run, name: str, duration_s: float, every_s: float) -> np.ndarray:
    """A series at `times`: the last row at or before each; NaN where the run has none."""
    t = times(duration_s, every_s)
    out = np.full(t.size, np.nan)
    try:
        values = SERIES[name].of(run)
    except KeyError:  # this closure has no such thing
        return out
    rows = np.searchsorted(run.t_s, t + _SLACK_S, "right") - 1
    good = (rows >= 0) & (t <= (run.t_s[-1] if run.t_s.size else -1.0) + every_s)
    out[good] = values[rows[good]]
    return out
