"""Correlation functions of replicas: what a closed-form correlator needs of a code."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from signals.replica import Replicas, replicas


class Correlations(NamedTuple):
    """Autocorrelation of each channel's replica over one period; made by `correlations`.

    R at lag k / per_chip[i] chips, 0 <= k <= period[i], is ``table[first[i] + k]``, and straight
    in between; R(0) = 1.
    """

    table: np.ndarray  # (n_total,)
    first: np.ndarray  # (n_channel,) int64
    period: np.ndarray  # (n_channel,) int64: in steps
    per_chip: np.ndarray  # (n_channel,) int64: steps to a chip
    kept: np.ndarray  # (n_channel,) share of the power that a filter leaves


def correlations(
    waveforms: Replicas,
    chip_rate_hz: np.ndarray | None = None,
    bandwidth_hz: float | None = None,
    finer: int = 16,
) -> Correlations:
    """Exact autocorrelations, or those of signals through an ideal filter of ``bandwidth_hz``.

    The spectrum of a replica is lines at multiples of its period's inverse; the filter keeps those
    within +- bandwidth_hz / 2 (of ``chip_rate_hz`` (n_channel,)).  The curve is smooth then and is
    given at ``finer`` steps to each of the replica's own.  The replica stays unfiltered: taps have
    the mean sqrt(kept) R and the noise covariance R.

    Raises
    ------
    ValueError : a replica without power, before or behind the filter.
    """
    rows, kept = [], []
    scale = 1 if bandwidth_hz is None else finer
    for i, (first, n) in enumerate(zip(waveforms.first, waveforms.length, strict=True)):
        values = waveforms.table[first : first + n].astype(np.float64)
        power = np.abs(np.fft.fft(values)) ** 2 / (float(n) * n)
        share = 1.0
        if bandwidth_hz is not None and chip_rate_hz is not None:
            k = np.arange(n * scale // 2 + 1)
            steps_hz = chip_rate_hz[i] * waveforms.per_chip[i]
            inside = k * (steps_hz / n) <= 0.5 * bandwidth_hz
            lines = np.where(inside, power[k % n] * np.sinc(k / n) ** 2, 0.0)
            row = np.fft.irfft(lines, n * scale) * (n * scale)
            share = row[0] / power.sum()
        else:
            row = np.fft.irfft(power[: n // 2 + 1], n) * n
            if np.array_equal(values, np.rint(values)):
                row = np.rint(row * n)  # sums of whole numbers
        if not row[0] > 0.0:
            raise ValueError(
                f"replica {i} has no power: its chips are 0, or the filter leaves none"
            )
        rows.append(np.append(row, row[0]) / row[0])
        kept.append(share)
    sizes = np.array([row.size for row in rows], dtype=np.int64)
    return Correlations(
        np.concatenate(rows),
        np.cumsum(sizes) - sizes,
        sizes - 1,
        waveforms.per_chip * scale,
        np.array(kept),
    )


def correlations_of(chips: np.ndarray | Replicas | Correlations) -> Correlations:
    """Those of chips (n_channel, length) or replicas, where they are not given already."""
    if isinstance(chips, Correlations):
        return chips
    if isinstance(chips, Replicas):
        return correlations(chips)
    if np.ndim(chips) != 2:
        raise ValueError(f"chips {np.shape(chips)}: expected (n_channel, length)")
    return correlations(replicas(list(chips)))


def tap_factor(own: Correlations, i: int, offset_chips: np.ndarray) -> np.ndarray:
    """Lower-triangular L with L L' = R(d_i - d_k), (n_tap, n_tap).

    Coincident taps have a zero pivot, and so has a third one between two less than a chip apart
    if R is straight there; the column of such a tap stays zero, it is a sum of those before it.
    """
    length = int(own.period[i])
    table = own.table[own.first[i] : own.first[i] + length + 1]
    lag = np.mod((offset_chips[:, None] - offset_chips[None, :]) * own.per_chip[i], length)
    left = np.interp(lag, np.arange(length + 1), table)
    factor = np.zeros_like(left)
    for k in range(offset_chips.size):
        if left[k, k] > 1e-12:
            factor[:, k] = left[:, k] / math.sqrt(left[k, k])
            left = left - np.outer(factor[:, k], factor[:, k])
    return factor
