"""The scene of the sample-level figures: twelve GPS C/A channels in noise.

Twelve satellites, Dopplers within +-4.5 kHz, 45 dB-Hz, int8 I and Q: the scene in which the
peers' figures were measured (`peers`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from signals.codes import GPS_L1CA
from signals.constants import CA_CHIP_RATE_HZ, GPS_L1_HZ
from signals.front_end import SyntheticIf
from signals.nco import Nco, Taps
from signals.propagation import SignalState
from signals.recording import Recording
from signals.reference import relative_error, taps_by_definition

N_CHANNEL = 12
CN0_DBHZ = 45.0


class Scene(NamedTuple):
    """Samples and the command that follows the signals in them."""

    state: SignalState
    recording: Recording
    chips: np.ndarray
    nco: Nco
    fs: float
    duration_s: float


def signal_state(duration_s: float, rate_hz_per_s: float = 0.0) -> SignalState:
    """The truth: constant Doppler rates, pieces of 5 ms."""
    n = round(duration_s / 0.005)
    t = np.arange(n + 1) * 0.005
    doppler = np.linspace(-4500.0, 4500.0, N_CHANNEL)
    now = t[:-1]
    carrier = np.zeros((N_CHANNEL, n, 4))
    carrier[..., 0] = doppler[:, None] * now + 0.5 * rate_hz_per_s * now**2
    carrier[..., 1] = doppler[:, None] + rate_hz_per_s * now
    carrier[..., 2] = 0.5 * rate_hz_per_s
    code = carrier * (CA_CHIP_RATE_HZ / GPS_L1_HZ)
    code[..., 0] += CA_CHIP_RATE_HZ * now  # from 0: every sample belongs to an integration
    code[..., 1] += CA_CHIP_RATE_HZ
    rng = np.random.default_rng(1)
    symbols = rng.choice(np.array([-1, 1], np.int8), (N_CHANNEL, round(duration_s / 0.02) + 3))
    valid = np.ones((N_CHANNEL, n), bool)
    return SignalState(t, code, carrier, np.full((N_CHANNEL, n), CN0_DBHZ), valid, symbols, 0)


def make(fs: float, dump_s: float, duration_s: float = 0.04, rate_hz_per_s: float = 0.0) -> Scene:
    """A scene at sampling rate ``fs`` whose command integrates over ``dump_s``."""
    state = signal_state(duration_s, rate_hz_per_s)
    chips = np.stack([GPS_L1CA.chips(p) for p in range(1, N_CHANNEL + 1)])
    source = SyntheticIf(state, chips, sample_rate_hz=fs, seed=1)
    t = np.arange(round(duration_s / 0.02) + 1) * 0.02
    piece = np.arange(len(t) - 1) * 4
    code, carrier = state.code_phase_chips, state.carrier_phase_cycles
    nco = Nco(
        t,
        code[:, piece, 0].T.copy(),
        code[:, piece, 1].T.copy(),
        carrier[:, piece, 0].T.copy(),
        carrier[:, piece, 1].T.copy(),
        2.0 * carrier[:, piece, 2].T.copy(),
        np.full(N_CHANNEL, round(dump_s * CA_CHIP_RATE_HZ), np.int64),
        np.ones(N_CHANNEL, bool),
    )
    recording = source.record(round(duration_s * fs))
    return Scene(state, recording, chips, nco, fs, duration_s)


def error(scene: Scene, taps: Taps, offsets: np.ndarray) -> float:
    """|taps - definition| / |definition| over all integrations and taps."""
    wanted = taps_by_definition(scene.recording, scene.chips, offsets, scene.nco, taps)
    return relative_error(taps.iq, wanted)
