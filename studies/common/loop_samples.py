"""What the study `loop_theory` draws without flying: slips, noise, S-curves, C/N0."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from common import open_loop
from common.loop_cells import LEVELS
from signals.codes import GPS_L1CA, GPS_L1CD
from signals.signal_row import Signal
from ultratight.tracking import cn0_estimators as estimators
from ultratight.tracking import loop_theory as theory
from ultratight.tracking import noisy_phase as noisy
from ultratight.tracking.discriminators import (
    CODE_DISCRIMINATORS,
    PHASE_DISCRIMINATORS,
    delay_error,
    phase_error,
    signal_peak,
)

SLIP_DB, SLIP_ORDERS = (0.0, 2.0, 4.0), (1, 2, 3)
Slips = dict[tuple[int, float], tuple[float, int]]


def time_to_slip(n_slip: int) -> Slips:
    """Mean time to slip [s] and number of slips, by order and loop SNR [dB], Bn = 1 Hz."""
    return {
        (order, db): open_loop.time_to_slip_s(order, 10.0 ** (0.1 * db), n_slip=n_slip)
        for order in SLIP_ORDERS
        for db in SLIP_DB
    }


SHOTS: dict[str, tuple[Signal, float | None, float]] = {
    "BPSK(1), D = 1": (GPS_L1CA, None, 0.5),
    "BPSK(1), D = 0.2": (GPS_L1CA, None, 0.1),
    "BPSK(1), 20.46 MHz, D = 0.1": (GPS_L1CA, 20.46e6, 0.05),
    "BPSK(1), 2.046 MHz, D = 0.2": (GPS_L1CA, 2.046e6, 0.1),
    "BOC(1,1), D = 0.2": (GPS_L1CD, None, 0.1),
    "BOC(1,1), 4.092 MHz, D = 0.2": (GPS_L1CD, 4.092e6, 0.1),
}
SHOT_LEVELS, SHOT_S = (20.0, 30.0, 50.0), 0.01
SHOT_KINDS = ("coherent", "dot-product", "power")


def one_shot(n: int) -> dict[str, np.ndarray]:
    """Square of each output over B&K's variance (kind, level, n) at zero error."""
    out = {}
    for name, (signal, band, s) in SHOTS.items():
        taps = open_loop.dumps(
            signal, np.array([-s, 0.0, s]), cn0_dbhz=np.array(SHOT_LEVELS), n_dump=n,
            integration_s=SHOT_S, bandwidth_hz=band,
        )  # fmt: skip
        of = theory.flank(signal.modulation, s, signal.chip_rate_hz, band)
        values = np.empty((len(SHOT_KINDS), len(SHOT_LEVELS), n))
        for i, kind in enumerate(SHOT_KINDS):
            for j, level in enumerate(SHOT_LEVELS):
                a2 = 2.0 * SHOT_S * of.power * theory.ratio_hz(level)
                error = discriminate(kind, taps[j], a2, of.slope, of.level)
                variance = theory.code_variance(kind, of, SHOT_S, level)
                values[i, j] = error**2 / variance
        out[name] = values
    return out


def discriminate(kind: str, taps: np.ndarray, a2: float, slope: float, level: float) -> np.ndarray:
    """Outputs (...) of a code discriminator for taps (..., 3) [chips]."""
    number_ = CODE_DISCRIMINATORS[kind]
    flat = [
        delay_error(number_, complex(e), complex(p), complex(x), a2, slope, level)
        for e, p, x in taps.reshape(-1, 3)
    ]
    return np.array(flat).reshape(taps.shape[:-1])


class Curves(NamedTuple):
    """S-curves of one signal and spacing: (kind, error); noisy ones with their standard error."""

    error_chips: np.ndarray
    quiet: np.ndarray
    formula: np.ndarray
    noisy: np.ndarray
    sigma: np.ndarray


class PhaseCurves(NamedTuple):
    """S-curves of the phase discriminators (kind, error) [cycles] in noise."""

    error_cycles: np.ndarray
    noisy: np.ndarray
    formula: np.ndarray
    sigma: np.ndarray


CURVE_SPACINGS, CURVE_DBHZ, CURVE_S = (0.1, 0.25, 0.5), 30.0, 0.01


def s_curves(n: int) -> tuple[dict[str, Curves], PhaseCurves]:
    """Of the code, by signal and spacing, without noise and in the mean of n; and of the phase."""
    error = np.linspace(-1.2, 1.2, 49)
    out = {}
    for signal, label in ((GPS_L1CA, "BPSK(1)"), (GPS_L1CD, "BOC(1,1)")):
        for s in CURVE_SPACINGS:
            if s == 0.5 and signal is GPS_L1CD:
                continue  # early and late stand at the zeros of BOC(1,1)
            offsets = np.array([-s, 0.0, s])
            out[f"{label}, D = {2.0 * s:g}"] = _code_curves(signal, s, offsets, error, n)
    phase = np.linspace(-0.5, 0.5, 41)
    a2 = 2.0 * CURVE_S * theory.ratio_hz(CURVE_DBHZ)
    z = open_loop.dumps(GPS_L1CA, np.zeros(1), phase_cycles=phase, cn0_dbhz=CURVE_DBHZ,
                        integration_s=CURVE_S, n_dump=n)[..., 0]  # fmt: skip
    found = np.array([
        [[phase_error(kind, complex(x), a2) for x in row] for row in z]
        for kind in PHASE_DISCRIMINATORS.values()
    ])  # fmt: skip
    formula = np.array([noisy.mean_phase_error(k, phase, a2) for k in PHASE_DISCRIMINATORS])
    sigma = found.std(axis=-1) / np.sqrt(n)
    return out, PhaseCurves(phase, found.mean(axis=-1), formula, sigma)


def _code_curves(
    signal: Signal, s: float, offsets: np.ndarray, error: np.ndarray, n: int
) -> Curves:
    """Formula: the modulation's R, of independent chips, in the discriminators' definitions."""
    a2 = 2.0 * CURVE_S * theory.ratio_hz(CURVE_DBHZ)
    slope, level = signal_peak(signal, 7, s)
    r = [signal.modulation.correlation(np.abs(error + d)) for d in offsets]
    kinds = tuple(CODE_DISCRIMINATORS)
    formula = np.array([
        discriminate(k, np.sqrt(a2) * np.stack(r, axis=-1).astype(complex), a2, slope, level)
        for k in kinds
    ])  # fmt: skip
    both = []
    for noise, count in ((False, 1), (True, n)):
        taps = open_loop.dumps(
            signal, offsets, delay_chips=error, cn0_dbhz=CURVE_DBHZ, integration_s=CURVE_S,
            n_dump=count, noise=noise,
        )  # fmt: skip
        both.append(np.array([discriminate(k, taps, a2, slope, level) for k in kinds]))
    quiet, found = both
    sigma = found.std(axis=-1) / np.sqrt(n)
    return Curves(error, quiet[..., 0], formula, found.mean(axis=-1), sigma)


def cn0_bias(n: int) -> dict[str, np.ndarray]:
    """Estimates minus truth (level, run) of one second each, in lock, NaN for none [dB]."""
    n_channel = max(n // 4, 1)
    z = open_loop.dumps(
        GPS_L1CA, np.zeros(1), cn0_dbhz=np.repeat(LEVELS, n_channel), integration_s=0.001,
        n_dump=4000, data=True,
    )[..., 0]  # fmt: skip
    z = z.reshape(len(LEVELS), 4 * n_channel, 1000)
    bits = z.reshape(*z.shape[:2], 50, 20).sum(axis=-1) / np.sqrt(20.0)
    truth = np.array(LEVELS)[:, None]
    return {
        "nwpr": estimators.nwpr(z, 0.001, 20, 0) - truth,
        "snv 20 ms": estimators.snv(bits, 0.02) - truth,
        "m2m4 20 ms": estimators.m2m4(bits, 0.02) - truth,
        "m2m4 1 ms": estimators.m2m4(z, 0.001) - truth,
    }
