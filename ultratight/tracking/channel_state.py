"""What the channels of the scalar closure remember, and what their loops are told once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from signals.constants import C_MPS, CA_CHIP_RATE_HZ, GPS_L1_HZ
from ultratight.tracking.kalman_loop import KalmanLoop, new_kalman_loop

WAVELENGTH_M = C_MPS / GPS_L1_HZ
CHIP_M = C_MPS / CA_CHIP_RATE_HZ
PLL, FLL_PLL, FLL = range(3)
CARRIER_LOOPS = {"pll": PLL, "fll-pll": FLL_PLL, "fll": FLL}
"""What runs once a channel has locked: the PLL, an FLL beside it, or an FLL alone"""
NWPR, M2M4, SNV = range(3)
CN0_ESTIMATORS = {"nwpr": NWPR, "m2m4": M2M4, "snv": SNV}
PULL_IN, ASSISTED, LOCKED = 0, 1, 2
CODE_S = 0.001
BIT_CODES = 20
BIT_S = BIT_CODES * CODE_S
HALF_BIT_S = 0.5 * BIT_S
POWER_GAIN = BIT_S / 1.0
"""C/N0: low pass of 1 s"""
LOCK_GAIN = BIT_S / 0.4
"""Indicators: low pass of 0.4 s, which forgives what a loop survives"""
SETTLING_S = 0.3
"""Pull-in takes at least this long"""
PATIENCE_S = 2.0
"""Pull-in and assisted phase start anew so long after they could have ended"""
FREQUENCY_FOUND_ABOVE = 0.5
"""cos(2 pi f 10 ms): 17 Hz, less at low C/N0"""
PHASE_FOUND_ABOVE = 0.6
PHASE_GOOD_ABOVE = 0.8
PHASE_LOST_BELOW = 0.4
FREQUENCY_LOST_BELOW = 0.2
"""A Costas loop can rest at a multiple of 1/(2 T), where the halves of the bit turn by 90 deg"""
CN0_LOST_BELOW_DBHZ = 15.0
CN0_FLOOR_DBHZ = 10.0
DIVERGENCE_S = 4.0
"""Code-carrier divergence: low pass; it is believed after twice that"""

FREQUENCY_FOUND, PHASE_FOUND, PHASE_LOST, FREQUENCY_LOST, CN0_LOST, NEVER, DIVERGED = range(7)
EVENTS = (
    ("frequency lock", "frequency lock indicator {:.2f}"),
    ("phase lock", "phase lock indicator {:.2f}"),
    ("loss of lock", "phase lock indicator {:.2f}"),
    ("loss of lock", "frequency lock indicator {:.2f}"),
    ("loss of lock", "C/N0 {:.1f} dB-Hz"),
    ("loss of lock", "no lock within {:.1f} s"),
    ("loss of lock", "code and carrier diverge by {:.2f} m/s"),
)
"""(kind, reason) by the code that `close_loops` gives"""


class Design(NamedTuple):
    """Gains of the loops for `filter_step`, and what they need to know of the signal."""

    block: int  # code periods in an integration of the locked phase
    block_assisted: int  # and of the assisted one
    pll: np.ndarray  # (3,)
    pll_assisted: np.ndarray  # (3,)
    pll_wide: np.ndarray  # (3,) locked, until it has settled
    assist: np.ndarray  # (3,) FLL beside the PLL, or in its place
    pull_in: np.ndarray  # (3,) FLL alone
    dll: np.ndarray  # (3,)
    dll_assisted: np.ndarray  # (3,)
    dll_pull_in: np.ndarray  # (3,) on single code periods
    slope: np.ndarray  # (n_channel,) of early minus late [1/chip]
    level: np.ndarray  # (n_channel,) of the correlation at early and late
    early_late: np.ndarray  # (n_channel,) variance of the noise of early minus late, per component
    settling_s: float  # the PLL is assisted at least this long
    narrow_after_s: float  # and stays wide for so long after phase lock
    carrier: int  # of CARRIER_LOOPS
    discriminators: tuple[int, int, int]  # of code, phase and frequency
    cn0: int  # of CN0_ESTIMATORS
    divergence_mps: float  # lock is lost above; inf: never
    bits: np.ndarray  # (n_channel, n_bit) int8 of +-1 to be wiped off; no columns for none
    first_bit: int  # number of the bit in column 0
    kalman: np.ndarray  # (4,) densities of the `KalmanLoop`


class Loops(NamedTuple):
    """All channels' memory; arrays are updated in place."""

    code_chips: np.ndarray  # (n_channel,) NCO code phase at the end of the command
    carrier_cycles: np.ndarray  # (n_channel,) NCO carrier phase there
    loop_hz: np.ndarray  # (n_channel,) carrier loop's share of the frequency
    loop_chips_per_s: np.ndarray  # (n_channel,) code loop's share of the chip rate
    carrier_memory: np.ndarray  # (n_channel, 2) Hz/s, Hz
    code_memory: np.ndarray  # (n_channel, 2) chips/s^2, chips/s
    feed: np.ndarray  # (n_channel, 2) fed forward: Hz, Hz/s
    feed_t_s: np.ndarray  # (1,) at this time
    last_good_hz: np.ndarray  # (n_channel,) loop frequency when the phase was last well locked
    phase: np.ndarray  # (n_channel,) int64: PULL_IN, ASSISTED, LOCKED
    since_s: np.ndarray  # (n_channel,) in this phase since
    first_lost_s: np.ndarray  # (n_channel,) NaN where never lost
    next_index: np.ndarray  # (n_channel,) int64, of the dump to come
    n_in_block: np.ndarray  # (n_channel,) int64
    n_in_bit: np.ndarray  # (n_channel,) int64, negative in a bit that is not whole
    block: np.ndarray  # (n_channel, 3) sums of early, prompt, late over the integration
    halves: np.ndarray  # (n_channel, 2) sums of the prompts over the halves of the bit
    last: np.ndarray  # (n_channel,) complex prompt before this one
    products: np.ndarray  # (n_channel,) sum of P_k conj(P_k-1) over the bit
    wide_now: np.ndarray  # (n_channel,) sum of |P_k|^2 over the bit
    narrow: np.ndarray  # (n_channel,) low pass of the narrow-band power
    wide: np.ndarray  # (n_channel,) and of the wide-band power
    cn0_dbhz: np.ndarray  # (n_channel,)
    phase_lock: np.ndarray  # (n_channel,) indicator
    frequency_lock: np.ndarray  # (n_channel,) indicator
    prompt: np.ndarray  # (n_channel,) complex, last whole bit, unit noise per component
    moments: np.ndarray  # (n_channel, 3) low passes of |P|^2, |P|^4 and |I| of the bits' prompts
    divergence_mps: np.ndarray  # (n_channel,) code range grows by so much faster than carrier's
    steer_s: np.ndarray  # (1,) time constant with which the NCO follows a `KalmanLoop`
    kalman: KalmanLoop  # in place of the filters of code and carrier, where it has channels


def new_loops(cn0_dbhz: np.ndarray, kalman: bool = False) -> Loops:
    """Loops at rest, told the C/N0 (n_channel,) to expect."""
    n = cn0_dbhz.size
    real, whole, turning = np.zeros, np.int64, np.complex128
    loops = Loops(
        real(n), real(n), real(n), real(n), real((n, 2)), real((n, 2)), real((n, 2)), real(1),
        real(n), real(n, whole), real(n), np.full(n, np.nan),
        np.full(n, -1, whole), real(n, whole), np.full(n, -BIT_CODES, whole),
        real((n, 3), turning), real((n, 2), turning), real(n, turning), real(n, turning),
        real(n), real(n), real(n),
        np.array(cn0_dbhz, dtype=np.float64), real(n), real(n), real(n, turning),
        real((n, 3)), real(n), np.full(1, CODE_S), new_kalman_loop(n if kalman else 0),
    )  # fmt: skip
    loops.frequency_lock[:] = 1.0  # the first Doppler is good to some Hz, until proved otherwise
    a2 = 2.0 * 10.0 ** (cn0_dbhz / 10.0) * CODE_S
    loops.narrow[:] = BIT_CODES * (BIT_CODES * a2 + 2.0)
    loops.wide[:] = BIT_CODES * (a2 + 2.0)
    bit2 = BIT_CODES * a2
    loops.moments[:, 0], loops.moments[:, 1] = bit2 + 2.0, bit2**2 + 8.0 * bit2 + 8.0
    loops.moments[:, 2] = np.sqrt(bit2)
    return loops
