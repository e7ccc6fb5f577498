"""Search for lost signals around the vector solution: cells of code phase and Doppler.

As long as the solution holds range and rate of a lost channel within the reach of its taps, its
replica stays where the solution says, and counts with the second bit of its signal.  Beyond that
(3 sigma of the predicted range or rate) the channel looks for its signal.  A cell is a place of
the replica; it covers

    code       the taps early, prompt, late: 3 spacings
    Doppler    +-312.5 Hz: each bit's 20 prompts of 1 ms are turned by multiples of 25 Hz and added

and is dwelt on for some bits, whose powers |X|^2 add up: without a signal chi-square with two
degrees of freedom per bit, with one noncentral by 2 A^2 per bit.  The threshold is that which the
largest of all taps and frequencies passes with the stated probability (as a sum over them, which
is not too little: neighbours are correlated).  Kaplan & Hegarty, 3rd ed., 8.5.  The dwell is as
long as a signal of the strength that the channel had before needs to pass with 0.9.  Whose signal
would need more than 25 bits waits where the solution says: away from there it would find nothing.

Cells go outwards through the ellipse of 3 sigma of (range, rate) that the covariance gives each
channel, in passes of 4, 8, 4, 16, 4, 8, 4, 32 ... of the nearest: nobody knows when the signal
will be back, and it is seldom far.  Every other channel stays nearer, with the square roots of
those powers of two.  Every pass begins where the solution says, for so long that the channel's
ordinary measurements would hear the signal there too; half of the channels that look are there at
any time, and all when one has joined, so that a motion as the model has it costs little.  A peak
is closed in on until it is the prompt's, within half a bin; the replica is held there, and the
channel heard and measured as any other.  It enters the solution together with another one (or
after a second alone), if their innovations agree.
"""

from __future__ import annotations

import math

import numpy as np

from signals.compiled import kernel
from signals.nco import Taps
from ultratight.tracking.channel_state import BIT_CODES, CODE_S
from ultratight.tracking.vector_dwell import (
    BIN_HZ,
    CELL_HZ,
    N_BIN,
    dwell,
    heard_after,
    threshold,
)

SIGMAS = 3.0
REACH_CHIPS, REACH_HZ = 0.5, 25.0
"""Of the discriminators: half bits turn by +-90 deg, the code's slope is believed"""
FIRST_PASS = 4
MOST_CELLS = (400, 40)
"""To each side: 88 km, 26 kHz at a spacing of 0.25 chips"""
CLOSING_STEPS = 4
CONFIRM_S, ALONE_S = 0.5, 1.0
"""So long a found channel may take to be heard; and to wait for a second one"""
MOST_BITS = 25
"""Dwell, unless a longer one is asked for"""
MEMORY_S = 5.0
"""Low pass of what a channel was worth before: slow beside the 1 s in which a weak one fades"""
AGREE = 1e-3
"""Probability that innovations of the model disagree"""
WITH_SOLUTION, LOOKING, CLOSING, FOUND = range(4)


class Search:
    """Where each channel's replica is held off the solution, and why.

    Parameters
    ----------
    amplitude2 : ndarray, (n_channel,)
        A^2 of half a bit's prompt that is expected (`vector_measurements`).
    spacing_chips : float
        Between neighbouring taps.
    update_s : float
        From command to command.
    bits : int
        Least dwell in a cell; 0: nobody searches.
    false_alarm : float
        Probability that a cell without a signal passes.
    """

    def __init__(
        self,
        amplitude2: np.ndarray,
        spacing_chips: float,
        update_s: float,
        bits: int,
        false_alarm: float,
    ) -> None:
        self.spacing, self.update_s, self.least = spacing_chips, update_s, bits
        self.false_alarm = false_alarm
        self.step_size = np.array([3.0 * spacing_chips, CELL_HZ])
        n = amplitude2.size
        self.amplitude2 = np.array(amplitude2, dtype=np.float64)
        """Of each channel while it counts"""
        self.dwell, self.wait, self.bits = np.zeros((3, n), dtype=np.int64)
        """In a cell, at the centre, and where the channel is"""
        self.threshold = np.full(n, np.inf)
        self.refused, self.told = np.zeros((2, n), dtype=np.bool_)
        """Contradicts the solution; has been said to, since the signal went"""
        self.state = np.full(n, WITH_SOLUTION)
        self.off = np.zeros((2, n))
        """Replica minus solution: chips, Hz"""
        self.dwell_s, self.since_s, self.began_s = np.zeros(n), np.zeros(n), np.zeros(n)
        self.passes, self.index, self.visited, self.tries = np.zeros((4, n), dtype=np.int64)
        self.called_back = False
        """Another one has joined the solution: the signals are back"""
        self.extent = np.zeros(n)
        """Area of the ellipse when the pass began"""
        self.prompts = np.zeros((n, BIT_CODES, 3), dtype=np.complex128)
        self.n_code, self.n_bit = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64)
        self.power = np.zeros((n, 3, N_BIN))

    @property
    def held(self) -> np.ndarray:
        """(n_channel,) bool: not with the solution."""
        return self.state != WITH_SOLUTION

    @property
    def looking(self) -> np.ndarray:
        """(n_channel,) bool: nothing found yet."""
        return (self.state == LOOKING) | (self.state == CLOSING)

    @property
    def deaf(self) -> np.ndarray:
        """(n_channel,) bool: away, or with the signal in another bin, of which half bits see an
        alias."""
        flat = self.power.reshape(len(self.power), -1)
        from_bin = np.abs(flat.argmax(axis=1) % N_BIN - N_BIN // 2)
        elsewhere = (flat.max(axis=1) > self.threshold) & (from_bin > 1)
        return self.looking & (~self._at_centre | elsewhere)

    @property
    def _at_centre(self) -> np.ndarray:
        return (self.state == LOOKING) & ~self.off.any(axis=0)

    def remember(self, amplitude2: np.ndarray, counts: np.ndarray) -> None:
        """What the channels that count are worth, after an update."""
        gain = min(1.0, self.update_s / MEMORY_S)
        self.amplitude2[counts] += gain * (amplitude2 - self.amplitude2)[counts]

    def take_in(self, taps: Taps) -> None:
        """Add the dumps (of one code period) of those who look."""
        looking = self.looking
        if looking.any():
            add_periods(
                taps.channel, taps.number, taps.t_start_s, taps.iq, taps.noise_var, looking,
                self.dwell_s, self.bits, self.prompts, self.n_code, self.n_bit, self.power,
            )  # fmt: skip

    def step(self, t_s: float, dark: np.ndarray, spread: np.ndarray) -> tuple[list[int], list[int]]:
        """Decide for each channel where its replica goes next.

        dark (n_channel,) bool: members that are not heard.  spread (n_channel, 2, 2): covariance
        of the predicted code phase and Doppler [chips, Hz].  Returns who has begun, and who listens
        at a new place from now: where something was found, or again at the centre.
        """
        began, anew = [], []
        for i in np.flatnonzero(dark | self.held).tolist():
            state = self.state[i]
            sigma = np.sqrt(np.diagonal(spread[i]))
            within = SIGMAS * sigma[0] <= REACH_CHIPS and SIGMAS * sigma[1] <= REACH_HZ
            if state == FOUND:
                if not dark[i]:
                    continue
                if t_s - self.since_s[i] > CONFIRM_S:
                    self.begin(i, t_s, spread[i])
                    anew.append(i)
            elif within or self.least == 0:
                self.release(i)
            elif state == WITH_SOLUTION:
                self._allot(i)
                if self.dwell[i] > max(self.least, MOST_BITS):
                    continue
                self.began_s[i], self.visited[i] = t_s, 0
                self.begin(i, t_s, spread[i])
                # not all away from the middle at the same time: the first two help the others
                self.passes[i], self.index[i] = 1 + i, i % FIRST_PASS
                began.append(i)
            elif self.called_back and state == LOOKING and self.off[:, i].any():
                self.begin(i, t_s, spread[i])
                anew.append(i)
            elif self.n_bit[i] >= self.bits[i]:
                was_there = self._at_centre[i]
                self._look(i, t_s, spread[i])
                if not was_there and (self.state[i] == FOUND or self._at_centre[i]):
                    anew.append(i)
        self.called_back = False
        return began, anew

    def _allot(self, i: int) -> None:
        """Bits for a signal as strong as the one that went."""
        a2 = float(self.amplitude2[i])
        most = max(self.least, MOST_BITS)
        self.dwell[i] = dwell(a2, self.spacing, self.false_alarm, self.least, most)
        self.wait[i] = max(self.dwell[i], heard_after(a2, 2 * most))

    def begin(self, i: int, t_s: float, spread: np.ndarray) -> None:
        """Start anew where the solution says."""
        self.state[i], self.passes[i], self.index[i] = LOOKING, 1, 0
        self.refused[i] = False
        self.extent[i] = _area(spread)
        self._go(i, t_s, np.zeros(2))

    def release(self, i: int) -> None:
        """Channel i goes with the solution."""
        self.called_back |= bool(self.state[i] == FOUND)
        self.state[i] = WITH_SOLUTION
        self.off[:, i] = 0.0
        self.refused[i] = self.told[i] = False

    def hold(self, i: int, t_s: float) -> None:
        """Channel i has its signal where it is."""
        self.state[i], self.since_s[i] = FOUND, t_s

    def refuse(self, i: int) -> bool:
        """Channel i contradicts the solution, and waits for a third; whether that is news."""
        news = not self.told[i]
        self.refused[i] = self.told[i] = True
        return news

    def ready(self, t_s: float, heard: np.ndarray, counting: int) -> np.ndarray:
        """Who (n_channel,) bool could join the solution, in which ``counting`` channels are.

        heard: with a signal, believed or not.  One alone joins late: a false alarm would not be
        heard for so long.
        """
        ready = (self.state == FOUND) & heard
        return ready & (counting + ready.sum() > 1 or t_s - self.since_s >= ALONE_S)

    def said(self, i: int, t_s: float) -> str:
        """Of channel i, before its release."""
        chips, hertz = self.off[:, i]
        return (
            f"search: {chips:+.2f} chips, {hertz:+.0f} Hz from the solution, "
            f"{self.visited[i]} cells in {t_s - self.began_s[i]:.2f} s"
        )

    def _look(self, i: int, t_s: float, spread: np.ndarray) -> None:
        """End of a dwell: go on, close in or hold."""
        tap, k = np.unravel_index(int(self.power[i].argmax()), self.power[i].shape)
        if self.power[i, tap, k] > self.threshold[i]:
            from_bin = int(k) - N_BIN // 2
            if tap == 1 and from_bin == 0:
                self.hold(i, t_s)
                return
            self.tries[i] = 1 if self.state[i] == LOOKING else self.tries[i] + 1
            if self.tries[i] <= CLOSING_STEPS:
                self.state[i] = CLOSING
                # a replica that is late is one of an earlier code phase
                step = np.array([(1 - int(tap)) * self.spacing, from_bin * BIN_HZ])
                self._go(i, t_s, self.off[:, i] + step)
                return
        self._next(i, t_s, spread)

    def _next(self, i: int, t_s: float, spread: np.ndarray) -> None:
        """To the next cell of the pass, or of the next pass."""
        if _area(spread) < 0.5 * self.extent[i]:  # others have been found
            self.begin(i, t_s, spread)
            return
        there = self._at_centre
        if there[i] and there.sum() <= self.looking.sum() // 2:
            self._go(i, t_s, np.zeros(2))
            return
        self.state[i] = LOOKING
        where = cells(spread, self.step_size)
        self.index[i] += 1
        doubled = float(self.passes[i] & -self.passes[i])
        # every other channel stays near: two are enough to bring all the others back
        length = FIRST_PASS * (doubled if i % 2 else math.sqrt(doubled))
        if self.index[i] >= min(length, len(where)):
            self.passes[i] = 1 if length >= len(where) else self.passes[i] + 1
            self.index[i], self.extent[i] = 0, _area(spread)
        self._go(i, t_s, where[self.index[i]])

    def _go(self, i: int, t_s: float, off: np.ndarray) -> None:
        self.off[:, i] = off
        self.bits[i] = self.dwell[i] if off.any() else self.wait[i]
        self.threshold[i] = threshold(int(self.bits[i]), self.false_alarm)
        self.dwell_s[i] = t_s + self.update_s  # the replica is on its way till then
        self.n_code[i], self.n_bit[i], self.power[i] = 0, 0, 0.0
        self.visited[i] += 1


def cells(spread: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Centres (n, 2) of the cells on the ellipse of 3 sigma, the likeliest first.

    spread (2, 2) of (chips, Hz); step (2,): size of a cell, whose own extent widens the ellipse.
    """
    wide = spread + np.diag(step**2 / 12.0)
    n, m = (int(min(SIGMAS * math.sqrt(wide[j, j]) / step[j], MOST_CELLS[j])) for j in range(2))
    grid = np.mgrid[-n : n + 1, -m : m + 1].reshape(2, -1).T * step
    distance = np.einsum("ni,ij,nj->n", grid, np.linalg.inv(wide), grid)
    order = np.argsort(distance, kind="stable")
    return grid[order[distance[order] <= SIGMAS**2]]


def agreeing(z: np.ndarray, A: np.ndarray, R: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """Which channels' innovations z (n, 2) have together what the prior cov lets expect, (n,) bool.

    The one that contradicts the others most is left out until they agree; of two nobody knows
    which, and none is left.
    """
    from scipy.special import gammainccinv  # slow to import

    keep = np.arange(len(z))
    while keep.size:
        if _nis(z[keep], A[keep], R[keep], cov) <= 2.0 * gammainccinv(keep.size, AGREE):
            break
        if keep.size == 2:
            keep = keep[:0]
            break
        without = [
            _nis(z[rest], A[rest], R[rest], cov)
            for rest in (np.delete(keep, j) for j in range(keep.size))
        ]
        keep = np.delete(keep, int(np.argmin(without)))
    return np.isin(np.arange(len(z)), keep)


def _nis(z: np.ndarray, A: np.ndarray, R: np.ndarray, cov: np.ndarray) -> float:
    rows = A.reshape(-1, A.shape[2])
    S = rows @ cov @ rows.T
    for j, own in enumerate(R):
        S[2 * j : 2 * j + 2, 2 * j : 2 * j + 2] += own
    return float(z.reshape(-1) @ np.linalg.solve(S, z.reshape(-1))) if len(z) else 0.0


def _area(spread: np.ndarray) -> float:
    return float(np.sqrt(max(np.linalg.det(spread), 0.0)))


# ---- kernels ---------------------------------------------------------------------------------


@kernel
def add_periods(
    channel: np.ndarray,
    index: np.ndarray,
    t_start_s: np.ndarray,
    iq: np.ndarray,
    noise_var: np.ndarray,
    looking: np.ndarray,
    dwell_s: np.ndarray,
    bits: np.ndarray,
    prompts: np.ndarray,
    n_code: np.ndarray,
    n_bit: np.ndarray,
    power: np.ndarray,
) -> None:
    """Gather dumps of one code period, iq (n_dump, 3), to bits; add the spectra of whole ones.

    Of channels that are looking, and of their bits that began after dwell_s; both (n_channel,).
    """
    for k in range(channel.size):
        i = channel[k]
        code = index[k] % BIT_CODES
        if not looking[i] or n_bit[i] == bits[i]:
            continue
        if code == 0 and t_start_s[k] >= dwell_s[i] - 0.5 * CODE_S:
            n_code[i] = 0
        elif code != n_code[i] or code == 0:  # a bit that is not whole
            n_code[i] = -1
            continue
        scale = 1.0 / math.sqrt(noise_var[k])
        for m in range(3):
            prompts[i, code, m] = iq[k, m] * scale
        n_code[i] += 1
        if n_code[i] == BIT_CODES:
            n_bit[i] += 1
            add_spectra(prompts[i], power[i])


@kernel
def add_spectra(prompts: np.ndarray, power: np.ndarray) -> None:
    """Add |X|^2 of a bit (20, 3) to power (3, n_bin); noise has 1 per component in X."""
    n_bin = power.shape[1]
    for b in range(n_bin):
        angle = -2.0 * math.pi * (b - n_bin // 2) * BIN_HZ * CODE_S
        for m in range(3):
            total = 0.0 + 0.0j
            for k in range(BIT_CODES):
                total += prompts[k, m] * complex(math.cos(angle * k), math.sin(angle * k))
            power[m, b] += (total.real**2 + total.imag**2) / BIT_CODES
