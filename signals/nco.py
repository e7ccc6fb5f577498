"""The handshake between receiver and correlator: an NCO command goes down, taps come up."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np


class Nco(NamedTuple):
    """What the receiver commands: every channel's replica, in pieces of receiver time.

    Inside piece p, which covers [t_s[p], t_s[p + 1]), with dt = t - t_s[p], channel i runs at

        code(t)    = code_phase_chips[p, i] + chip_rate_hz[p, i] dt                      [chips]
        carrier(t) = carrier_phase_cycles[p, i] + carrier_freq_hz[p, i] dt
                     + carrier_rate_hz_per_s[p, i] dt^2 / 2                              [cycles]

    The carrier is above the intermediate frequency.  The code phase is absolute (it counts from
    the code epoch that began at the start of the data bit under way at the run's nominal start,
    see `propagation.SignalState`), hence code periods and data-bit edges are multiples.
    Integrations run from one multiple of ``dump_chips`` of that phase to the next, across pieces
    and commands; a change of ``dump_chips`` drops the open sum and starts at the next multiple.
    """

    t_s: np.ndarray  # (n_piece + 1,) receiver time since the start of the run [s]
    code_phase_chips: np.ndarray  # (n_piece, n_channel)
    chip_rate_hz: np.ndarray  # (n_piece, n_channel)
    carrier_phase_cycles: np.ndarray  # (n_piece, n_channel)
    carrier_freq_hz: np.ndarray  # (n_piece, n_channel)
    carrier_rate_hz_per_s: np.ndarray  # (n_piece, n_channel)
    dump_chips: np.ndarray  # (n_channel,) int64: length of an integration
    valid: np.ndarray  # (n_channel,) bool: channels to be correlated


class Taps(NamedTuple):
    """A table of the integrations that finished, in order of channel, then of time.

    ``iq`` is the sum of sample times conjugate carrier times delayed code, scaled so that the
    thermal noise has variance ``noise_var`` (1) in each of I and Q: its mean is
    sqrt(2 C/N0 T) R(offset - delay error) exp(j 2 pi (carrier phase error)), cf. Kaplan &
    Hegarty, 3rd ed., ch. 8.
    """

    channel: np.ndarray  # (n_dump,) int64, index into the channel axis of the Nco
    number: np.ndarray  # (n_dump,) int64, code phase at the start / dump_chips
    t_start_s: np.ndarray  # (n_dump,) receiver time of the first sample [s]
    t_end_s: np.ndarray  # (n_dump,) receiver time of the first sample after it [s]
    iq: np.ndarray  # (n_dump, n_tap) complex128
    noise_var: np.ndarray  # (n_dump,) per component
    code_start_chips: np.ndarray  # (n_dump,) NCO code phase at t_start_s
    code_end_chips: np.ndarray  # (n_dump,) NCO code phase at t_end_s
    carrier_start_cycles: np.ndarray  # (n_dump,) NCO carrier phase at t_start_s
    carrier_end_cycles: np.ndarray  # (n_dump,) NCO carrier phase at t_end_s


class Correlator(Protocol):
    """Anything that turns commands into taps: `SampleCorrelator` or `ModelCorrelator`."""

    offset_chips: np.ndarray
    """(n_tap,) delay of each replica: negative is early, positive is late [chips]"""

    def __call__(self, nco: Nco) -> Taps:
        """Correlate over all pieces of the command; return the integrations that ended."""
        ...
