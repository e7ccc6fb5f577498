"""What the values of a recording look like."""

from __future__ import annotations

from typing import Any

import numpy as np

from signals.recording import Recording

_FEW = 16
_BINS = 16


def summary(recording: Recording) -> dict[str, Any]:
    """Format, rate, length, mean, r.m.s. and how often each level occurs, as plain data.

    Mean (I and Q, or one number), r.m.s. and levels are those of at most 2^20 samples, spread
    evenly.  ``levels`` is the share of each value where there are up to 16, else of 16 equal
    intervals, "low to high".

    Raises
    ------
    ValueError : values that are NaN or inf.
    """
    values = np.concatenate([v.astype(np.float64) for v in recording.spread()])
    if not np.isfinite(values).all():
        wrong = values[~np.isfinite(values)][0]
        raise ValueError(f"{recording.name}: a sample is {wrong}, expected finite values")
    levels, counts = np.unique(values, return_counts=True)
    names = [f"{level:g}" for level in levels]
    if len(levels) > _FEW:
        counts, edges = np.histogram(values, _BINS)
        names = [f"{a:.4g} to {b:.4g}" for a, b in zip(edges[:-1], edges[1:], strict=True)]
    mean = values.mean(axis=0)
    return {
        "format": recording.format.name,
        "rate_hz": recording.sample_rate_hz,
        "if_hz": recording.if_hz,
        "n_samples": len(recording),
        "duration_s": len(recording) / recording.sample_rate_hz,
        "sigma": recording.sigma,
        "mean": mean.tolist(),
        "rms": np.sqrt(((values - mean) ** 2).mean(axis=0)).tolist(),
        "measured_samples": len(values),
        "levels": dict(zip(names, (counts / values.size).tolist(), strict=True)),
    }
