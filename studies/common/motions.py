"""Profiles that are made by a formula: vibration and turns."""

from __future__ import annotations

from typing import Any

import numpy as np

G = 9.80665
Profile = list[dict[str, float]]


def vibration(rms_g: float, t0_s: float, t1_s: float, step_s: float = 0.02) -> Profile:
    """Acceleration along the velocity: linear between independent values every ``step_s``.

    Linear interpolation keeps 2/3 of the power of the values; the same motion in every run.
    """
    n = round((t1_s - t0_s) / step_s)
    values = rms_g * G * np.sqrt(1.5) * np.random.default_rng(0).standard_normal(n + 1)
    values = np.round(values - values.mean(), 3)
    return [
        {
            "t0_s": round(t0_s + k * step_s, 6),
            "t1_s": round(t0_s + (k + 1) * step_s, 6),
            "accel0_mps2": float(values[k]),
            "accel1_mps2": float(values[k + 1]),
        }
        for k in range(n)
    ]


def turns(load_g: float, speed_mps: float, times_s: tuple[float, float, float]) -> Profile:
    """Level turns at constant speed, first to the right, then to the left."""
    rate = float(np.degrees(load_g * G / speed_mps))
    return [
        {"t0_s": start, "t1_s": stop, "turn_rate0_deg_s": sign * rate,
         "turn_rate1_deg_s": sign * rate}
        for start, stop, sign in zip(times_s[:-1], times_s[1:], (1.0, -1.0), strict=True)
    ]  # fmt: skip


def window(profile: Profile) -> dict[str, Any]:
    """Override that flies the profile and judges the time from its beginning to its end."""
    return {"profile": profile, "jump_window_s": [profile[0]["t0_s"], profile[-1]["t1_s"]]}
