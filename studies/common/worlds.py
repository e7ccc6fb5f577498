"""What the studies fly: measurement models, filters, mechanisms; all as overrides of a preset."""

from __future__ import annotations

from typing import Any

from ultratight.filters.catalog import CATALOG

Change = dict[str, Any]

MODELS: dict[str, Change] = {
    "C": {"receiver.measurement": "coherent"},
    "D": {"receiver.measurement": "differential"},
}
"""Coherent I/Q with the carrier phases as states, and I/Q of the phase change within a bit"""

FILTERS: dict[str, Change] = {
    "KF": {"receiver.filter": "kf"},
    "QKF": {"receiver.filter": "qkf"},
    "FIQKF": {"receiver.filter": "fiqkf"},
    "FIQKF-R": {"receiver.filter": "fiqkf-r"},
    "FIQKF-C": {"receiver.filter": "fiqkf-c"},
    "QKF+intQ": {"receiver.filter": "qkf-intq"},
    "20-state": {"receiver.filter": "qkf-20"},
    "QKF+vrw": {"receiver.filter": "qkf-vrw0.1"},
    "QKF+int2": {"receiver.filter": "qkf-int2"},
    "IMM2": {"receiver.filter": "imm2"},
    "JTQ": {"receiver.filter": "jtq"},
    "JTQ-E": {"receiver.filter": "jtq-e"},
    "JTQ-R": {"receiver.filter": "jtq-r"},
    "J1": {"receiver.filter": "j1"},
    "IO": {"receiver.filter": "io"},
}
"""Label in tables and figures -> overrides; `filters` keeps those that the catalogue has"""

CAUSE_OFF: Change = {"imu.accel_scale_factor_ppm": [0.0, 0.0, 0.0]}
MATCHED: Change = {**CAUSE_OFF, "imu.grade": "matched", "imu.lag_s": 0.0}
"""Biases, noise and clock as the filter believes them, and nothing else"""


def _scale_factor(ppm: float) -> Change:
    return {"imu.accel_scale_factor_ppm": [ppm, 0.0, 0.0]}


def _oscillator(model: str, ppb: float) -> Change:
    return {"clock.model": model, "clock.g_sensitivity_ppb_per_g": ppb}


MECHANISMS: dict[str, Change] = {
    name: MATCHED | change
    for name, change in {
        "none": {},
        "scale factor 3000 ppm": _scale_factor(3000.0),
        "scale factor 10000 ppm": _scale_factor(10_000.0),
        "misalignment 1 mrad": {"imu.misalignment_mrad": 1.0},
        "gyro 10 deg/h/g": {"imu.gyro_g_dependence_deg_h_g": 10.0},
        "lag 10 ms": {"imu.lag_s": 0.01},
        "saturation 10 g": {"imu.saturation_g": 10.0},
        "TCXO 1 ppb/g": _oscillator("tcxo", 1.0),
        "OCXO 1 ppb/g": _oscillator("ocxo", 1.0),
        "combined": {
            **_scale_factor(3000.0), "imu.lag_s": 0.005, "clock.g_sensitivity_ppb_per_g": 0.3
        },
        "scale factor 30000 ppm": _scale_factor(30_000.0),
        "lag 30 ms": {"imu.lag_s": 0.03},
        "saturation 9 g": {"imu.saturation_g": 9.0},
        "TCXO 3 ppb/g": _oscillator("tcxo", 3.0),
        "OCXO 3 ppb/g": _oscillator("ocxo", 3.0),
    }.items()
}  # fmt: skip
"""One error at a time in an otherwise perfect IMU, and one combination"""


def filters(*labels: str) -> dict[str, Change]:
    """The filters of these labels that the catalogue has, in this order."""
    return {
        label: FILTERS[label] for label in labels if FILTERS[label]["receiver.filter"] in CATALOG
    }


def mechanisms(*names: str) -> dict[str, Change]:
    """The mechanisms of these names, in this order."""
    return {name: MECHANISMS[name] for name in names}
