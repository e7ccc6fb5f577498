"""Acquisition: which satellites are in the samples, and where their replicas have to begin.

The energies S of B blocks (`code_search`) are judged against the level of the noise that they
themselves show: the median over the delays, over that of the distribution.  Without a satellite S
over its mean has a gamma distribution of shape B and mean 1, and the largest of n cells is above u
with a probability of at most n Q(B, B u) (Kaplan & Hegarty, 3rd ed., 8.5.2; Q is the regularised
upper incomplete gamma function).  Neighbouring cells are correlated, which leaves 0.75 to 1 of the
stated rate in white noise.

The level is taken from each Doppler row and from all of them, the larger counts; lines of
narrow-band interference are blanked before (`excision`).
Total power would not do: on real recordings noise is coloured, and every code receives up to 1/129
of a strong satellite's power (C/A at any Doppler, -21.1 dB: Kaplan & Hegarty, 3rd ed., 4.3).  What
is too strong for that is found at once; what else is above the threshold has to be so again in
samples from which the strong ones were taken (`signal_removal`), those of SBAS and QZSS too, asked
for or not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from signals.codes import GPS_L1CA
from signals.recording import IfSource
from signals.signal_row import Signal
from ultratight.tracking.code_search import Grid, energies, grid
from ultratight.tracking.fine_acquisition import Fine, code_sense, refine
from ultratight.tracking.signal_removal import without

_CROSS_POWER = 10.0 ** (-21.1 / 10.0)
"""Largest share of a satellite's power in another one's correlation, GPS C/A at any Doppler"""
_SAFETY = 2.0
_UNSEEN_DBHZ = 50.0
"""What a satellite may have that is not searched"""
_ON_AIR = {"L1CA": (*range(1, 33), *range(120, 159), *range(183, 207))}
"""Codes that are sent: GPS, SBAS, QZSS (IS-GPS-200 table 3-Ia, 6-I; IS-QZSS-PNT 3.2)"""
_SENSE_SIGMA = 0.2
_OFFSET_SIGMAS, _OFFSET_HZ = 6.0, (700.0, 15e3)
"""Five of these are between right and undecided"""
_ALIKE_HZ, _CHANCE = 4.0, 1e-4
"""Dopplers that are the same, and how often satellites may be thought to share one by chance"""
_FINE_S = 0.1
"""What is taken of a recording for the fine estimates, if it is that long"""


@dataclass(frozen=True)
class Search:
    """What is searched, and how surely."""

    doppler_hz: float = 5000.0
    """Both ways"""
    coherent_s: float | None = None
    """Whole code periods; None: one"""
    noncoherent: int = 10
    """Blocks of ``coherent_s`` whose energies are added"""
    doppler_step_hz: float | None = None
    """At most; None: 1 / (2 ``coherent_s``), more would lose too much half-way"""
    delays_per_chip: float | None = None
    """At least; None: 2 of BPSK, 4 of BOC signals"""
    false_alarm: float = 1e-3
    """Probability of finding a PRN that is not there, over its whole grid"""

    def __post_init__(self) -> None:
        _within("doppler_hz", self.doppler_hz, 0.0, 1e6)
        _within("noncoherent", self.noncoherent, 1, 100_000)
        if not 0.0 < self.false_alarm < 1.0:
            raise ValueError(f"false_alarm is {self.false_alarm}: expected more than 0, below 1")
        if self.delays_per_chip is not None:
            _within("delays_per_chip", self.delays_per_chip, 1.0, 100.0)

    def grid(self, source: IfSource, signal: Signal, first_sample: int) -> Grid:
        """Where the energies are taken.

        Raises
        ------
        ValueError
            No whole code periods, a Doppler step that is too coarse or absurdly fine.
        """
        period_s = signal.length_chips / signal.chip_rate_hz
        coherent_s = period_s if self.coherent_s is None else self.coherent_s
        periods = round(coherent_s / period_s) if 0.0 < coherent_s < 100.0 else 0
        if periods < 1 or abs(coherent_s / period_s - periods) > 1e-6:
            raise ValueError(
                f"coherent_s is {coherent_s:g}: expected a multiple of the code period of "
                f"{signal.name}, {period_s:g} s"
            )
        steps = 2
        if self.doppler_step_hz is not None:
            most = 0.5 / coherent_s
            _within("doppler_step_hz", self.doppler_step_hz, most / 50.0, most)
            steps = math.ceil(1.0 / (self.doppler_step_hz * coherent_s) - 1e-9)
        return grid(
            source, signal, first_sample=first_sample, periods=periods, blocks=self.noncoherent,
            doppler_hz=self.doppler_hz, steps=steps, delays_per_chip=self.delays_per_chip,
        )  # fmt: skip


class Acquisition(NamedTuple):
    """What a search says of a satellite; code phase, Doppler and C/N0 mean nothing if not found."""

    prn: int
    code_phase_chips: float
    """Chip of the primary code under reception at ``sample_index``, from 0 to its length"""
    doppler_hz: float
    """Positive when approaching"""
    cn0_dbhz: float
    peak: float
    """Highest energy over the noise level"""
    threshold: float
    """What ``peak`` must exceed"""
    sample_index: int
    """Number of the sample to which the code phase belongs"""

    @property
    def found(self) -> bool:
        """Is it there?"""
        return self.peak > self.threshold


class Surface(NamedTuple):
    """Energies of one PRN over the noise level."""

    doppler_hz: np.ndarray  # (n_doppler,)
    code_phase_chips: np.ndarray  # (n_delay,)
    energy: np.ndarray  # (n_doppler, n_delay)


def threshold(n_cells: int, blocks: int, false_alarm: float) -> float:
    """Energy over its mean that the largest of ``n_cells`` exceeds with ``false_alarm`` at most."""
    from scipy.special import gammainccinv  # slow to import

    return float(gammainccinv(blocks, -math.expm1(math.log1p(-false_alarm) / n_cells))) / blocks


def acquire(
    source: IfSource,
    signal: Signal = GPS_L1CA,
    prns: Sequence[int] | None = None,
    search: Search | None = None,
    first_sample: int | None = None,
) -> list[Acquisition]:
    """Search for satellites from ``first_sample`` (None: the source's first) on; a row per PRN.

    ``prns`` is 1 to 32 of GPS unless given, and every PRN of other systems.  Fine estimates are of
    up to 0.1 s, or of what was searched where that is longer.  C/N0 is that against noise and
    interference as they are, after the correlation loss of the front end's filter; on unfiltered
    samples of C/A and 0.1 s its bias is within 0.1 dB and its standard deviation 0.3 to 0.15 dB
    from 36 to 50 dB-Hz, that of the code phase 0.03 to 0.004 chips, of the Doppler 0.25 to 0.05 Hz.

    Raises
    ------
    ValueError
        Fewer samples than are to be searched, PRNs without a code, samples that are not finite, a
        band that holds less than half of the signal.
    """
    search = search or Search()
    prns = _prns(signal, prns)
    first = int(getattr(source, "first_sample", 0)) if first_sample is None else first_sample
    g = search.grid(source, signal, first)
    end = _checked_end(source, g)
    limit = threshold(len(g.bins) * g.n_delay, g.n_block, search.false_alarm)
    peaks = _peaks(source, g, prns)
    sure, doubtful = _sorted(peaks, g, limit)
    if doubtful:
        others = [p for p in _ON_AIR.get(signal.label, ()) if p not in prns]
        strong = sure + _sorted(_peaks(source, g, others), g, limit)[0]
        if strong:
            known = _fine(source, g, strong, g.end_sample)
            clean = without(
                source, signal, [p.prn for p in strong], known, g.first_sample, g.end_sample
            )
            again = {p.prn: p for p in _peaks(clean, g, [p.prn for p in doubtful])}
            peaks = [again.get(p.prn, p) for p in peaks]
    found = [p for p in peaks if p.peak > limit]
    rows = {p.prn: p for p in peaks}
    if found:
        for p, *fine in zip(
            found, *(v.tolist() for v in _fine(source, g, found, end)), strict=True
        ):
            rows[p.prn] = p._replace(**dict(zip(Fine._fields, fine, strict=True)))
    return [Acquisition(*rows[prn], limit, g.first_sample) for prn in prns]


def surface(
    source: IfSource, signal: Signal, prn: int, search: Search, first_sample: int | None = None
) -> Surface:
    """The energies of one PRN as they are searched, for a look at them.

    Raises
    ------
    ValueError
        As `acquire` does.
    """
    first = int(getattr(source, "first_sample", 0)) if first_sample is None else first_sample
    g = search.grid(source, signal, first)
    _checked_end(source, g)
    ((_, energy),) = energies(source, g, _prns(signal, [prn]))
    levels = _levels(energy, g.n_block)[0]
    return Surface(g.doppler_hz, g.code_phase_chips, energy[0] / levels[:, None])


class Misfit(NamedTuple):
    """What is wrong with a description, as codes and carriers show it."""

    inverted: bool
    """Dopplers have the wrong sign: Q is negated, or a mixer took the other sideband"""
    offset_hz: float
    """By how much the carriers stand higher than the IF says; 0 where that is not sure"""


def misfit(source: IfSource, signal: Signal, rows: Sequence[Acquisition]) -> Misfit:
    """Do codes run against carriers, or beside them?

    Neither, where it cannot be told: too few samples, satellites or Hz.  An oscillator that is off
    moves both, if it drives mixer and sampler.
    """
    found = [row for row in rows if row.found]
    if not found:
        return Misfit(False, 0.0)
    at = Fine(*(np.array([getattr(row, name) for row in found]) for name in Fine._fields))
    first = found[0].sample_index
    end = min(int(getattr(source, "end_sample", first)), first + round(source.sample_rate_hz))
    s = code_sense(source, signal, [row.prn for row in found], at, first, end)
    if s.sense_sigma < _SENSE_SIGMA and s.sense < 0.0:
        return Misfit(True, 0.0)
    least, most = max(_OFFSET_SIGMAS * s.offset_sigma_hz, _OFFSET_HZ[0]), _OFFSET_HZ[1]
    sure = least < abs(s.offset_hz) < most  # beyond, these are no satellites' codes
    return Misfit(False, s.offset_hz if sure else 0.0)


def alike(signal: Signal, rows: Sequence[Acquisition]) -> int:
    """How many of those found share a Doppler modulo half the code's rate; 0: no more than chance.

    A code that repeats every T has a spectrum of lines 1 / T apart: one strong satellite, or a
    line, comes through every other code at its own Doppler plus a multiple of 1 / T, and of
    1 / (2 T) as bits leave half a turn per T open.  Satellites that are there have Dopplers that
    are uniform modulo so little.  Of N, a given one then has n - 1 others within 4 Hz above it with
    the binomial probability P(X >= n - 1), X of N - 1 trials of 4 Hz * 2 T each, and some one at
    most N times that, which must be below 1e-4: 4 of 4, 5 of 9 or 6 of 20 for C/A codes.
    """
    from scipy.special import bdtrc  # slow to import

    at = np.array([row.doppler_hz for row in rows if row.found])
    if not at.size:
        return 0
    apart = 0.5 * signal.chip_rate_hz / signal.length_chips
    n = int(((at - at[:, None]) % apart < _ALIKE_HZ).sum(axis=1).max())
    chance = at.size * bdtrc(n - 2, at.size - 1, min(_ALIKE_HZ / apart, 1.0)) if n > 1 else 1.0
    return n if chance < _CHANCE else 0


class _Peak(NamedTuple):
    """The first fields of an `Acquisition`."""

    prn: int
    code_phase_chips: float
    doppler_hz: float
    cn0_dbhz: float
    peak: float


def _peaks(source: IfSource, g: Grid, prns: Sequence[int]) -> list[_Peak]:
    """The highest cell of each PRN."""
    found = []
    for some, energy in energies(source, g, prns):
        rows = energy.max(axis=2) / _levels(energy, g.n_block)
        for i, (prn, d) in enumerate(zip(some, rows.argmax(axis=1).tolist(), strict=True)):
            delay, peak = int(energy[i, d].argmax()), float(rows[i, d])
            # the Doppler between rows: vertex of the parabola through three energies
            sides = energy[i, max(d - 1, 0) : d + 2, delay].astype(float)
            step = _vertex(sides) if sides.size == 3 else 0.0
            doppler = float(g.doppler_hz[d]) + step * g.sample_rate_hz / g.n_fft
            cn0 = 10.0 * math.log10(max(peak - 1.0, 1e-9) / g.block_s)
            found.append(_Peak(prn, float(g.code_phase_chips[delay]), doppler, cn0, peak))
    return found


def _sorted(peaks: Sequence[_Peak], g: Grid, limit: float) -> tuple[list[_Peak], list[_Peak]]:
    """Those above the threshold: too strong to be another's cross-correlation, and the others."""
    above = [p for p in peaks if p.peak > limit]
    unseen = 10.0 ** (_UNSEEN_DBHZ / 10.0) * g.block_s
    strength = sum(p.peak - 1.0 for p in above) + unseen
    bars = [limit + _SAFETY * _CROSS_POWER * (strength - p.peak + 1.0) for p in above]
    sure = [p for p, bar in zip(above, bars, strict=True) if p.peak > bar]
    return sure, [p for p in above if p not in sure]


def _fine(source: IfSource, g: Grid, peaks: Sequence[_Peak], end: int) -> Fine:
    """Fine estimates at the first sample."""
    start = Fine(*(np.array([getattr(p, name) for p in peaks]) for name in Fine._fields))
    return refine(source, g.signal, [p.prn for p in peaks], start, g.first_sample, end)


def _vertex(y: np.ndarray) -> float:
    """Where the parabola through y at -1, 0, 1 is highest, y[1] being no lower than the others."""
    bend = 2.0 * y[1] - y[0] - y[2]
    return 0.5 * float((y[2] - y[0]) / bend) if bend > 0.0 else 0.0


def _levels(energy: np.ndarray, blocks: int) -> np.ndarray:
    """Mean of the noise's energy (n_prn, n_doppler), from medians over the delays."""
    from scipy.special import gammaincinv

    # every other delay: neighbours share half of their noise
    rows = np.median(energy[:, :, ::2], axis=2) * (blocks / float(gammaincinv(blocks, 0.5)))
    return np.maximum(rows, np.median(rows, axis=1)[:, None])


def _prns(signal: Signal, prns: Sequence[int] | None) -> list[int]:
    if prns is None:
        return [p for p in signal.prns if signal.system != "G" or p <= 32]
    chosen = list(dict.fromkeys(int(p) for p in prns))
    if not chosen:
        raise ValueError("prns: none given, expected at least one")
    for prn in chosen:
        signal.chips(prn)  # says which there are
    return chosen


def _checked_end(source: IfSource, g: Grid) -> int:
    """End of the samples for fine estimates; ValueError: too few to be searched."""
    name = getattr(source, "name", "the source")
    last = int(getattr(source, "end_sample", g.end_sample))
    least = int(getattr(source, "first_sample", 0))
    if g.first_sample < least or g.end_sample > last:
        raise ValueError(
            f"{name}: samples {least} to {last}, expected {g.first_sample} to {g.end_sample}, as "
            f"{g.n_block} x {g.block_s * 1e3:g} ms are searched"
        )
    searched = source.samples(g.first_sample, g.end_sample)
    if (searched == searched[0]).all():
        raise ValueError(
            f"{name}: samples {g.first_sample} to {g.end_sample}, those to be searched, are all "
            "equal, expected a signal (--skip leaves out the beginning)"
        )
    wanted = g.first_sample + round(_FINE_S * g.sample_rate_hz)
    return min(last, max(wanted, g.end_sample))


def _within(name: str, value: float, least: float, most: float) -> None:
    if not least <= value <= most:
        raise ValueError(f"{name} is {value:g}: expected {least:g} to {most:g}")
