"""Settings of the scalar closure, and the gains that follow from them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from signals.codes import GPS_L1CA
from ultratight.tracking.channel_state import (
    BIT_S,
    CARRIER_LOOPS,
    CN0_ESTIMATORS,
    SETTLING_S,
    WAVELENGTH_M,
    Design,
)
from ultratight.tracking.discriminators import (
    CODE_DISCRIMINATORS,
    FREQUENCY_DISCRIMINATORS,
    PHASE_DISCRIMINATORS,
    check_peak,
    signal_peak,
)
from ultratight.tracking.kalman_loop import densities
from ultratight.tracking.knows import Knows
from ultratight.tracking.loop_filters import frequency_loop, phase_loop

EPOCH_S = 0.001
INTEGRATIONS_MS = (1, 2, 4, 5, 10, 20)
WIDE_BANDWIDTH_HZ = 12.0
"""Of the PLL until it has settled, at least: the FLL's noise would swamp a narrow one"""
SETTLING_BN = 6.0
"""Bn times the time constant of the slow pair of poles of the third-order loop"""
NO_BITS = np.zeros((0, 0), dtype=np.int8)


class ScalarSettings(NamedTuple):
    """What the closure may be told; see `ultratight.loop_keys` for the meanings."""

    integration_s: float = 0.02
    bandwidth_hz: float = 18.0
    fll_bandwidth_hz: float = 2.0
    dll_bandwidth_hz: float = 1.0
    pll_order: int = 3
    dll_order: int = 1
    fll_order: int | None = None
    loop: str = "filters"
    carrier_loop: str = "pll"
    code_discriminator: str = "dot-product"
    carrier_discriminator: str = "atan"
    frequency_discriminator: str = "atan2"
    cn0_estimator: str = "nwpr"
    code_carrier_limit_mps: float | None = None
    pull_in_bandwidth_hz: float = 5.0
    pull_in_dll_bandwidth_hz: float | None = None
    assisted_integration_s: float | None = None
    assisted_bandwidth_hz: float | None = None
    assisted_dll_bandwidth_hz: float | None = None
    jerk_mps3_sqrt_hz: float = 3.0
    divergence_m_sqrt_s: float = 0.1
    aiding_latency_s: float = 0.0
    aiding_clock: str = "first"


def design(settings: ScalarSettings, told: Knows | np.ndarray, spacing_chips: float) -> Design:
    """Gains of all loops; raises ValueError for settings that mean nothing.

    ``told``: what the receiver knows, or the PRN (n_channel,) alone where that is all.
    """
    s, late = settings, 0.5 * EPOCH_S
    block = _periods("integration_s", s.integration_s)
    first_s = s.integration_s if s.assisted_integration_s is None else s.assisted_integration_s
    block_assisted = _periods("assisted_integration_s", first_s)
    order = _check(s)
    wide_hz = max(s.bandwidth_hz, WIDE_BANDWIDTH_HZ)
    first_hz = wide_hz if s.assisted_bandwidth_hz is None else s.assisted_bandwidth_hz
    assist = np.zeros(3)
    if s.fll_bandwidth_hz > 0.0:
        _, assist = frequency_loop(order, s.fll_bandwidth_hz, BIT_S, late)

    def dll(bandwidth_hz: float | None, interval_s: float) -> np.ndarray:
        hz = s.dll_bandwidth_hz if bandwidth_hz is None else bandwidth_hz
        return phase_loop(s.dll_order, hz, interval_s, late)[1]

    slope, level, early_late = _peaks(s, told, spacing_chips)
    bits, first_bit, clock_sf, clock_sg = _told(s, told)
    return Design(
        block,
        block_assisted,
        phase_loop(s.pll_order, s.bandwidth_hz, s.integration_s, late)[1],
        phase_loop(s.pll_order, first_hz, first_s, late)[1],
        phase_loop(s.pll_order, wide_hz, s.integration_s, late)[1],
        assist,
        frequency_loop(order, s.pull_in_bandwidth_hz, BIT_S, late)[1],
        dll(None, s.integration_s),
        dll(s.assisted_dll_bandwidth_hz, first_s),
        dll(s.pull_in_dll_bandwidth_hz, EPOCH_S),
        slope,
        level,
        early_late,
        max(SETTLING_S, SETTLING_BN / first_hz),
        3.0 * SETTLING_BN / wide_hz,
        CARRIER_LOOPS[s.carrier_loop],
        (
            CODE_DISCRIMINATORS[s.code_discriminator],
            PHASE_DISCRIMINATORS[s.carrier_discriminator],
            FREQUENCY_DISCRIMINATORS[s.frequency_discriminator],
        ),
        CN0_ESTIMATORS[s.cn0_estimator],
        np.inf if s.code_carrier_limit_mps is None else s.code_carrier_limit_mps,
        bits,
        first_bit,
        densities(s.jerk_mps3_sqrt_hz, s.divergence_m_sqrt_s, clock_sf, clock_sg, WAVELENGTH_M),
    )


def _periods(name: str, seconds: float) -> int:
    """Code periods in an integration."""
    block = round(seconds / EPOCH_S) if np.isfinite(seconds) else 0
    if block not in INTEGRATIONS_MS or abs(seconds - block * EPOCH_S) > 1e-9:
        raise ValueError(
            f"{name} is {seconds}: expected "
            f"{', '.join(str(ms) for ms in INTEGRATIONS_MS)} ms, a divisor of the data bit"
        )
    return block


def _check(s: ScalarSettings) -> int:
    """Refuse what means nothing; returns the order of the FLL."""
    if s.pll_order not in (2, 3):
        raise ValueError(f"pll_order is {s.pll_order}: expected 2 or 3")
    if s.dll_order not in (1, 2):
        raise ValueError(f"dll_order is {s.dll_order}: expected 1 or 2")
    if not 0.0 <= s.fll_bandwidth_hz < np.inf:
        raise ValueError(f"fll_bandwidth_hz is {s.fll_bandwidth_hz}: expected >= 0")
    tables = {
        "carrier_loop": CARRIER_LOOPS,
        "code_discriminator": CODE_DISCRIMINATORS,
        "carrier_discriminator": PHASE_DISCRIMINATORS,
        "frequency_discriminator": FREQUENCY_DISCRIMINATORS,
        "cn0_estimator": CN0_ESTIMATORS,
        "loop": ("filters", "kalman"),
        "aiding_clock": ("first", "learnt"),
    }
    for name, table in tables.items():
        if getattr(s, name) not in table:
            raise ValueError(f"{name} is {getattr(s, name)!r}: expected one of {', '.join(table)}")
    for name in ("jerk_mps3_sqrt_hz", "divergence_m_sqrt_s", "aiding_latency_s"):
        if not 0.0 <= getattr(s, name) < np.inf:
            raise ValueError(f"{name} is {getattr(s, name)}: expected >= 0")
    alone = s.carrier_loop == "fll"
    if alone and s.fll_bandwidth_hz == 0.0:
        raise ValueError('fll_bandwidth_hz is 0.0: expected more than 0 with carrier_loop "fll"')
    order = s.pll_order - 1 if s.fll_order is None else s.fll_order
    if order not in (1, 2) or (order >= s.pll_order and not alone):
        raise ValueError(
            f"fll_order is {order}: expected 1 or 2, and less than pll_order = {s.pll_order} "
            "beside a PLL"
        )
    return order


def _told(s: ScalarSettings, told: Knows | np.ndarray) -> tuple[np.ndarray, int, float, float]:
    """Data bits to be wiped off, and the oscillator's two noises."""
    bits, first, sf, sg = NO_BITS, 0, 0.0, 0.0
    if isinstance(told, Knows):
        sf, sg = told.process_noise.clock_sf, told.process_noise.clock_sg
    if s.carrier_discriminator == "atan2":
        if not isinstance(told, Knows) or told.data_bits is None:
            raise ValueError('carrier_discriminator is "atan2": expected known data bits')
        bits, first = np.ascontiguousarray(told.data_bits, dtype=np.int8), int(told.first_bit)
    return bits, first, sf, sg


def _peaks(
    s: ScalarSettings, told: Knows | np.ndarray, spacing_chips: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Slope, level and noise of early minus late, (n_channel,) each."""
    prn = told.prn if isinstance(told, Knows) else told
    rows = []
    for p in prn:
        peak = signal_peak(GPS_L1CA, int(p), spacing_chips)
        check_peak(s.code_discriminator, peak)
        apart = np.interp(2.0 * spacing_chips, np.arange(3), GPS_L1CA.autocorrelation(int(p))[:3])
        rows.append((*peak, 2.0 * (1.0 - float(apart))))
    slope, level, early_late = np.array(rows).reshape(-1, 3).T.copy()
    return slope, level, early_late
