"""Open loop: taps at known errors, and loops of the first order on prompts drawn one by one.

Every channel receives the same code with its own errors and C/N0; the replicas run on undisturbed.
"""

from __future__ import annotations

import numpy as np

from signals.correlations import Correlations, correlations
from signals.correlator_model import ModelCorrelator
from signals.nco import Nco
from signals.noise import generator
from signals.propagation import SignalState
from signals.replica import replicas
from signals.signal_row import Signal
from ultratight.tracking.discriminators import PHASE_DISCRIMINATORS, phase_error
from ultratight.tracking.loop_filters import filter_step, phase_loop
from ultratight.tracking.loop_theory import ratio_hz

NODE_S = 0.005


def dumps(
    signal: Signal,
    offset_chips: np.ndarray,
    *,
    delay_chips: np.ndarray | float = 0.0,
    phase_cycles: np.ndarray | float = 0.0,
    frequency_hz: np.ndarray | float = 0.0,
    cn0_dbhz: np.ndarray | float = 45.0,
    integration_s: float = 0.01,
    n_dump: int = 1,
    prn: int = 7,
    seed: int = 1,
    noise: bool = True,
    data: bool = False,
    bandwidth_hz: float | None = None,
) -> np.ndarray:
    """Taps (n_channel, n_dump, n_tap) at errors, true - replica, that stay as they are.

    The errors and C/N0 broadcast to (n_channel,); symbols are 1, or random with ``data``.
    """
    delay, phase, frequency, cn0 = (
        np.array(x)
        for x in np.broadcast_arrays(*map(np.atleast_1d, (delay_chips, phase_cycles,
                                                          frequency_hz, cn0_dbhz)))
    )  # fmt: skip
    n, rate = delay.size, signal.chip_rate_hz
    end_s = (n_dump + 0.5) * integration_s
    t = np.arange(np.ceil(end_s / NODE_S) + 1) * NODE_S
    zero = np.zeros((n, t.size - 1))
    code = np.stack([rate * t[:-1] + delay[:, None], zero + rate, zero, zero], axis=-1)
    hz = frequency[:, None]
    carrier = np.stack([phase[:, None] + hz * t[:-1], zero + hz, zero, zero], axis=-1)
    symbol_chips = signal.symbol_chips
    n_symbol = int(rate * t[-1] / symbol_chips) + 4
    signs = np.ones((n, n_symbol), dtype=np.int8)
    if data:
        signs -= 2 * generator(seed, "open-loop").integers(0, 2, signs.shape, dtype=np.int8)
    state = SignalState(t, code, carrier, zero + cn0[:, None], zero == 0.0, signs, -2)
    correlator = ModelCorrelator(
        state, _shared(signal, prn, n, bandwidth_hz), 1 + np.arange(n), offset_chips, seed,
        symbol_chips=symbol_chips, period_chips=signal.length_chips, noise=noise,
    )  # fmt: skip
    still = np.zeros((1, n))
    length = np.full(n, round(integration_s * rate), dtype=np.int64)
    command = Nco(
        np.array([0.0, end_s]), still, still + rate, still, still, still, length,
        np.ones(n, dtype=np.bool_),
    )  # fmt: skip
    return correlator(command).iq.reshape(n, -1, len(offset_chips))[:, :n_dump]


def _shared(signal: Signal, prn: int, n: int, bandwidth_hz: float | None) -> Correlations:
    """One correlation function for n channels."""
    own = correlations(
        replicas([signal.subchips(prn)], signal.per_chip), np.array([signal.chip_rate_hz]),
        bandwidth_hz, 64,
    )  # fmt: skip
    return own._replace(
        first=np.zeros(n, np.int64), period=np.repeat(own.period, n),
        per_chip=np.repeat(own.per_chip, n), kept=np.repeat(own.kept, n),
    )  # fmt: skip


def cn0_of_loop_snr(loop_snr: float, bandwidth_hz: float, integration_s: float) -> float:
    """C/N0 [dB-Hz] at which a Costas loop has 1 / (2 sigma)^2 = loop_snr, squaring loss included.

    1 / loop_snr = 4 Bn / c (1 + 1 / (2 T c)), a quadratic equation in 1 / c.
    """
    a = 4.0 * bandwidth_hz * loop_snr
    c = 0.5 * (a + np.sqrt(a * a + 2.0 * a / integration_s))
    return float(10.0 * np.log10(c))


def time_to_slip_s(
    order: int, loop_snr: float, *, bandwidth_hz: float = 1.0,
    integration_s: float = 0.002, n_loop: int = 3000, n_slip: int = 1200, seed: int = 1,
) -> tuple[float, int]:  # fmt: skip
    """Mean time until a Costas loop is half a cycle away [s], and how many slips that is from.

    The receiver's own discriminator (I Q) and filter, n_loop at a time, on an integrating NCO; a
    loop that has slipped goes on from its new place of rest, with the filter as it is.
    """
    rng = generator(seed, f"slip-{order}-{loop_snr:.3f}")
    _, gains = phase_loop(order, bandwidth_hz, integration_s)
    cn0 = cn0_of_loop_snr(loop_snr, bandwidth_hz, integration_s)
    a2 = 2.0 * ratio_hz(cn0) * integration_s
    error, rate = np.zeros(n_loop), np.zeros(n_loop)
    memory = [np.zeros(n_loop), np.zeros(n_loop)]
    slips, spent = 0, 0.0
    settling = round(3.0 / (bandwidth_hz * integration_s))
    k = 0
    while slips < n_slip:
        prompt = np.sqrt(a2) * np.exp(2j * np.pi * (error - 0.5 * integration_s * rate))
        prompt = prompt + rng.standard_normal(n_loop) + 1j * rng.standard_normal(n_loop)
        error = error - integration_s * rate
        cycles = phase_error.py_func(PHASE_DISCRIMINATORS["product"], prompt, a2)
        rate = step(memory, cycles, integration_s, gains)
        away = np.abs(error) >= 0.5
        error[away] -= np.sign(error[away]) * 0.5
        k += 1
        if k > settling:
            slips += int(away.sum())
            spent += n_loop * integration_s
    return spent / slips, slips


def step(
    memory: list[np.ndarray], error: np.ndarray, interval_s: float, gains: np.ndarray
) -> np.ndarray:
    """`filter_step` of many loops at once."""
    rate: np.ndarray = filter_step.py_func(memory, error, interval_s, gains)
    return rate
