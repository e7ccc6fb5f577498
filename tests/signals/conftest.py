"""Truths and commands from polynomials, for the tests of both correlators."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from signals.constants import CA_CHIP_RATE_HZ
from signals.nco import Nco, Taps
from signals.propagation import SignalState
from signals.recording import Recording
from signals.replica import Replicas

CYCLES_PER_CHIP = 1540.0  # IS-GPS-200 3.3.1.1: 154 x 10.23 MHz over 1.023 Mcps


def motion(chips: Any, cycles: Any, doppler: Any, rate: Any, jerk: Any, t: np.ndarray) -> Any:
    """Code and carrier (n_channel, n_t, 4) as cubics about each t; (n_channel,) given at t = 0."""
    f0, f1, f2 = (np.atleast_1d(x).astype(float)[:, None] for x in (doppler, rate, jerk))
    carrier = np.stack(
        [
            np.atleast_1d(cycles)[:, None] + t * (f0 + t * (f1 / 2 + t * f2 / 6)),
            f0 + t * (f1 + t * f2 / 2),
            (f1 + t * f2) / 2 + 0 * f0,
            f2 / 6 + 0 * (t + f0),
        ],
        axis=-1,
    )
    code = carrier / CYCLES_PER_CHIP
    code[..., 0] += np.atleast_1d(chips)[:, None] - np.atleast_1d(cycles)[:, None] / CYCLES_PER_CHIP
    code[..., 0] += CA_CHIP_RATE_HZ * t
    code[..., 1] += CA_CHIP_RATE_HZ
    return code, carrier


@pytest.fixture(scope="session")
def truth() -> Callable[..., SignalState]:
    """Builder of a `SignalState` whose carrier is a cubic in time and whose code follows it."""

    def build(
        chips: Any = 0.0,
        cycles: Any = 0.0,
        doppler_hz: Any = 0.0,
        rate_hz_per_s: Any = 0.0,
        jerk_hz_per_s2: Any = 0.0,
        cn0_dbhz: Any = 45.0,
        duration_s: float = 0.1,
        step_s: float = 5e-3,
        symbols: np.ndarray | None = None,
        first_symbol: int = -1,
    ) -> SignalState:
        inputs = (chips, cycles, doppler_hz, rate_hz_per_s, jerk_hz_per_s2, cn0_dbhz)
        *kinematics, cn0 = np.broadcast_arrays(*(np.atleast_1d(x).astype(float) for x in inputs))
        t_s = np.arange(round(duration_s / step_s) + 1) * step_s
        code, carrier = motion(*kinematics, t_s[:-1])
        shape = code.shape[:2]
        if symbols is None:
            symbols = np.ones((shape[0], round(duration_s * 50) + 4), np.int8)
        power = np.repeat(cn0[:, None], shape[1], axis=1)
        return SignalState(t_s, code, carrier, power, np.ones(shape, bool), symbols, first_symbol)

    return build


@pytest.fixture(scope="session")
def command() -> Callable[..., Nco]:
    """Builder of an `Nco` that follows the same kind of motion, sampled at its pieces."""

    def build(
        t_s: Any,
        chips: Any = 0.0,
        cycles: Any = 0.0,
        doppler_hz: Any = 0.0,
        rate_hz_per_s: Any = 0.0,
        dump_chips: Any = 1023,
    ) -> Nco:
        kinematics = np.broadcast_arrays(
            *(np.atleast_1d(x).astype(float) for x in (chips, cycles, doppler_hz, rate_hz_per_s))
        )
        t_s = np.asarray(t_s, dtype=float)
        code, carrier = motion(*kinematics, 0.0, t_s)
        n_channel = len(code)
        pieces = np.ascontiguousarray(np.swapaxes(carrier[:, :-1], 0, 1))
        code_phase = np.ascontiguousarray(code[:, :, 0].T)
        return Nco(
            t_s,
            code_phase[:-1].copy(),
            np.diff(code_phase, axis=0) / np.diff(t_s)[:, None],
            pieces[..., 0].copy(),
            pieces[..., 1].copy(),
            2.0 * pieces[..., 2],
            np.broadcast_to(np.asarray(dump_chips, np.int64), (n_channel,)).copy(),
            np.ones(n_channel, bool),
        )

    return build


@pytest.fixture(scope="session")
def definition() -> Callable[..., np.ndarray]:
    """Taps by their definition: every code index and every phase its own, in float64."""

    def evaluate(
        source: Recording, nco: Nco, waveforms: Replicas, offset_chips: np.ndarray, taps: Taps
    ) -> np.ndarray:
        fs, out = source.sample_rate_hz, np.empty(taps.iq.shape, complex)
        starts = np.ceil(nco.t_s * fs - 1e-5)
        for row, i in enumerate(taps.channel):
            n = np.arange(round(taps.t_start_s[row] * fs), round(taps.t_end_s[row] * fs))
            p = np.searchsorted(starts, n, side="right") - 1
            dt = n / fs - nco.t_s[p]
            x = nco.code_phase_chips[p, i] + nco.chip_rate_hz[p, i] * dt
            cycles = nco.carrier_phase_cycles[p, i] % 1.0 + nco.carrier_freq_hz[p, i] * dt
            cycles += 0.5 * nco.carrier_rate_hz_per_s[p, i] * dt**2 + source.if_hz * n / fs
            samples = source.samples(n[0], n[-1] + 1).astype(float)
            wiped = (samples[:, 0] + 1j * samples[:, 1]) * np.exp(-2j * np.pi * cycles)
            period = waveforms.table[waveforms.first[i] :][: waveforms.length[i]].astype(float)
            index = np.floor((x - offset_chips[:, None]) * waveforms.per_chip[i]).astype(int)
            out[row] = period[index % period.size] @ wiped / (source.sigma * np.sqrt(n.size))
        return out

    return evaluate
