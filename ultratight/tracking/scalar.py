"""The conventional closure: every channel has its own carrier and code loop.

A channel goes through three phases (Kaplan & Hegarty, 3rd ed., ch. 8), each step an event:

    pull-in    FLL alone
    assisted   FLL-assisted PLL
    locked     PLL alone, Costas; its thermal jitter is the textbook's

and back to pull-in on loss of lock.  An FLL may stay beside the PLL, or be all there is
(``carrier_loop``); a Kalman filter may take over from the loop filters after pull-in (``loop``).

The FLL works on products of successive 1 ms prompts, which see +-500 Hz, while its indicator is
bad, else on the two halves of a data bit (+-50 Hz).  The DLL is carrier-aided throughout.  Dumps
are single code periods; the loops add them up to ``integration_s``, inside data bits, whose edges
are known.  The integration's end moves against the 1 ms epochs, hence a command acts half an epoch
late on average; the loop filters are designed for that.

With INS aiding the Doppler that a free-running INS, the ephemerides and the clock drift, the first
or a learnt one, predict is fed forward, late if so told; the same loops then track what is left.
"""

from __future__ import annotations

import numpy as np

from signals.code_start import code_phase_origin
from signals.constants import C_MPS, CA_CHIP_RATE_HZ
from signals.nco import Nco, Taps
from ultratight.ins.imu import Increments
from ultratight.tracking.channel_aiding import CLOCK_S, Delayed, feed_forward, learn_clock
from ultratight.tracking.channel_loops import advance, close_loops
from ultratight.tracking.channel_state import EVENTS, LOCKED, WAVELENGTH_M, Loops, new_loops
from ultratight.tracking.knows import Knows
from ultratight.tracking.loop_design import (
    BIT_S,
    EPOCH_S,
    INTEGRATIONS_MS,
    ScalarSettings,
    design,
)
from ultratight.tracking.positioning import least_squares
from ultratight.tracking.rows import Fields, Rows
from ultratight.tracking.steering import antenna, start

CODE_CHIPS = 1023
__all__ = [
    "BIT_S",
    "CODE_CHIPS",
    "EPOCH_S",
    "INTEGRATIONS_MS",
    "Scalar",
    "ScalarSettings",
    "design",
]


class Scalar:
    """A receiver of independent channels: `steer` gives the command, `step` takes the taps.

    Parameters
    ----------
    knows : Knows
        Everything that the receiver is told at the start; data bits serve a PLL without Costas.
    settings : ScalarSettings
    spacing_chips : float
        Early and late replicas stand this far from the prompt.
    piece_s : float
        IMU interval.
    aided : bool
        Feed the INS's Doppler forward.

    Raises
    ------
    ValueError
        A setting that is out of range, by name.
    """

    epoch_s = EPOCH_S
    diverged = False  # its channels pull in again for ever

    def __init__(
        self,
        knows: Knows,
        settings: ScalarSettings,
        spacing_chips: float,
        piece_s: float,
        aided: bool,
    ) -> None:
        self.knows, self.settings, self.aided = knows, settings, aided
        n = self.n_channel = knows.prn.size
        self.design = design(settings, knows, spacing_chips)
        self.steering, self.sky = start(knows, piece_s)
        self.loops: Loops = new_loops(knows.cn0_dbhz, settings.loop == "kalman")
        self._delayed = Delayed(settings.aiding_latency_s)
        self.t_s = 0.0
        self.events: list[tuple[float, int, str, str]] = []
        self.dump_chips = np.full(n, CODE_CHIPS, dtype=np.int64)
        self.valid = np.ones(n, dtype=np.bool_)
        self._origin = code_phase_origin(knows.start_tow_s)
        self._start()

    def _start(self) -> None:
        k, s, loops = self.knows, self.steering, self.loops
        loops.code_chips[:] = self._origin - CA_CHIP_RATE_HZ * s.rho / C_MPS
        loops.carrier_cycles[:] = -s.rho / WAVELENGTH_M
        doppler = -s.rho_rate / WAVELENGTH_M
        if self.aided:
            loops.feed[:, 0] = doppler
        else:
            loops.loop_hz[:] = loops.carrier_memory[:, 1] = loops.last_good_hz[:] = doppler
        r, v = antenna(s.buffer, self.n_channel)
        self._solution = np.array([*r, k.clock_m, *v, k.clock_rate_mps])

    def steer(self, t_end_s: float, imu: Increments) -> Nco:
        """Command one piece up to t_end_s; ``imu`` has what ended by then, and serves the next."""
        t_s = np.array([self.t_s, t_end_s])
        out = np.empty((5, 1, self.n_channel))
        advance(self.t_s, t_end_s, self.loops, out)
        if self.aided:
            imu = self._delayed(imu, t_end_s)
        if self.aided and imu.alpha_ib_b.shape[0]:
            self.sky.reach(t_end_s)
            feed_forward(
                imu.t_s,
                imu.alpha_ib_b,
                imu.nu_ib_b,
                self.steering.buffer,
                self.sky.arcs,
                self.loops,
            )
            if self.settings.aiding_clock == "learnt":
                share = (imu.t_s[-1] - imu.t_s[0]) / CLOCK_S
                learn_clock(self.steering.buffer, share, self.loops)
        self.t_s = t_end_s
        return Nco(t_s, out[0], out[1], out[2], out[3], out[4], self.dump_chips, self.valid)

    def step(self, taps: Taps) -> None:
        """Let each dump act on the loops of its channel."""
        happened = close_loops(
            taps.channel,
            taps.number,
            taps.t_end_s,
            taps.iq,
            taps.noise_var,
            self.loops,
            self.design,
        )
        for t_s, channel, code, value in happened:
            kind, reason = EVENTS[int(code)]
            self.events.append((float(t_s), int(channel), kind, reason.format(value)))

    @property
    def first_lost_s(self) -> np.ndarray:
        """(n_channel,) first loss of lock [s], NaN where there was none."""
        return self.loops.first_lost_s

    @property
    def locked(self) -> np.ndarray:
        """(n_channel,) bool: phase lock."""
        return self.loops.phase == LOCKED

    @property
    def doppler_hz(self) -> np.ndarray:
        """(n_channel,) Doppler as the carrier loops know it now [Hz].

        The third-order loop's integrator has a tenth of the noise of the NCO's frequency and does
        not lag behind an acceleration; that of the second-order loop does, by 1.414 a / w.
        """
        loops = self.loops
        ahead = loops.feed[:, 1] * (self.t_s - loops.feed_t_s[0])
        third = self.settings.pll_order == 3
        return (loops.carrier_memory[:, 1] if third else loops.loop_hz) + loops.feed[:, 0] + ahead

    @property
    def cn0_dbhz(self) -> np.ndarray:
        """(n_channel,) running estimate of C/N0 [dB-Hz]."""
        return self.loops.cn0_dbhz

    def pvt(self) -> tuple[np.ndarray, np.ndarray, float, float]:
        """Antenna position, velocity (ECEF), clock [m] and drift [m/s]; NaN without a solution.

        From code phase and Doppler of the locked channels, at the end of the epoch.
        """
        k = self.knows
        rho = C_MPS * (self.t_s - (self.loops.code_chips - self._origin) / CA_CHIP_RATE_HZ)
        rate = -WAVELENGTH_M * self.doppler_hz
        tow_s = k.start_tow_s + self.t_s
        x = self._solution
        if not least_squares(k.elements, tow_s, rho, rate, self.locked, x):
            x = np.full(8, np.nan)
        return x[0:3].copy(), x[4:7].copy(), float(x[3]), float(x[7])

    def snapshot(self) -> dict[str, np.ndarray]:
        """What each channel (n_channel,) knows of itself now."""
        loops = self.loops
        return {
            "doppler_hz": self.doppler_hz,
            "carrier_phase_cycles": loops.carrier_cycles.copy(),
            "code_phase_chips": loops.code_chips.copy(),
            "cn0_dbhz": loops.cn0_dbhz.copy(),
            "phase_lock": loops.phase_lock.copy(),
            "frequency_lock": loops.frequency_lock.copy(),
            "tracking_phase": loops.phase.copy(),
            "prompt": loops.prompt.copy(),
            "code_carrier_divergence_mps": loops.divergence_mps.copy(),
        }

    def fields(self) -> Fields:
        """What is kept of each row of the history."""
        channel = ((self.n_channel,), ("channel",))
        return {
            "r_eb_e": ((3,), ("xyz",), "m", "estimated position, ECEF; least squares"),
            "v_eb_e": ((3,), ("xyz",), "m/s", "estimated velocity, ECEF; least squares"),
            "clock_m": ((), (), "m", "estimated receiver clock bias"),
            "clock_rate": ((), (), "m/s", "estimated receiver clock drift"),
            "lock_indicator": (*channel, "1", "phase lock indicator, cos of twice the error"),
            "frequency_lock": (*channel, "1", "frequency lock indicator"),
            "tracking_phase": (*channel, "1", "0 pull-in, 1 assisted, 2 locked"),
            "cn0": (*channel, "dB-Hz", "estimated C/N0"),
            "code_carrier_divergence": (*channel, "m/s", "code range rate less the carrier's"),
            "prompt_i": (*channel, "standard deviations of the noise", "in-phase prompt, one bit"),
            "prompt_q": (*channel, "standard deviations of the noise", "quadrature prompt"),
        }

    def write(self, rows: Rows, k: int) -> None:
        """Write row k of each field; the lever arm is taken off with the INS's attitude."""
        r, v, clock_m, clock_rate = self.pvt()
        if self.aided:
            s = self.steering
            r_antenna, v_antenna = antenna(s.buffer, self.n_channel)
            r += s.r_eb_e - r_antenna
            v += s.v_eb_e - v_antenna
        loops = self.loops
        rows["r_eb_e"][k] = r
        rows["v_eb_e"][k] = v
        rows["clock_m"][k] = clock_m
        rows["clock_rate"][k] = clock_rate
        rows["lock_indicator"][k] = loops.phase_lock
        rows["frequency_lock"][k] = loops.frequency_lock
        rows["tracking_phase"][k] = loops.phase
        rows["cn0"][k] = loops.cn0_dbhz
        rows["code_carrier_divergence"][k] = loops.divergence_mps
        rows["prompt_i"][k] = loops.prompt.real
        rows["prompt_q"][k] = loops.prompt.imag
