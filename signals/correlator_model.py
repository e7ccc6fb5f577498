"""Correlator in closed form: the taps that samples would give, from the replica's errors only.

Over an integration of length T the tap at offset d (chips) is

    X_d = sqrt(2 / T) int sqrt(C/N0) D(t) R(e(t) + d) exp(j 2 pi phi(t)) dt + n_d         (1)

with e = true - NCO code phase, phi = true - NCO carrier phase, D the data symbol and R the code's
*own* periodic autocorrelation (`correlations`; not the ideal triangle).  For constant errors (1)
is sqrt(2 C/N0 T) D R(e + d) sinc(f T) exp(j 2 pi phi_mid): Kaplan & Hegarty, 3rd ed., ch. 8.
The noise has unit variance in each of I and Q and covariance R(d_i - d_k) between taps.

The integral is exact but for quadrature, below 2e-7 of the amplitude (`error_integral`).  What
(1) leaves out: products of chips are replaced by their mean over a code period, i.e. the
self-noise of parts of a period (a data edge inside the integration; phase errors that turn by a
good part of a cycle per period) and of sampling.  `tests/signals/test_correlators_agree.py`
measures it against samples.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from signals.compiled import borrowing, kernel
from signals.correlations import Correlations, correlations_of, tap_factor
from signals.error_integral import (
    SPREAD,
    edge,
    integrate,
    replica_at,
    truth_piece,
)
from signals.front_end import GUARD_SAMPLES
from signals.nco import Nco, Taps
from signals.noise import normals, stream_key
from signals.propagation import SignalState
from signals.replica import Replicas
from signals.truth_table import FAR, check_symbols, truth_table

_TIME_TOLERANCE_S = 1e-10


class ModelCorrelator:
    """Taps in closed form; a `Correlator` that needs the truth.

    Open sums persist between calls and are dropped as by `SampleCorrelator`: by a command that
    does not begin where the last one ended, an invalid channel, a change of ``dump_chips``, a code
    phase that leaves the integration under way by more than half its length.  The noise of an
    integration is keyed by (seed, prn, its first chip, its length): it depends on no order of
    calls or channels, and runs that differ in anything else share it.

    Parameters
    ----------
    state : truth at the antenna.
    chips : (n_channel, length) int8 of +-1, `replicas`, or `correlations`.
    prn : (n_channel,) names the channels in the key of their noise: whole numbers below 65536.
    offset_chips : (n_tap,) delay of each replica: negative is early, positive is late.
    seed : of the run; the noise is its stream "correlator-noise".
    symbol_chips : length of a symbol in chips, of all channels or of each.
    period_chips : integrations are multiples of it, of all channels or of each; None: of the
        replica's period.
    multiple_access : the other satellites add white noise, var = 1 + sum_j (C_j/N0) 2 / (3 Rc)
        (`signals.truth_table`); ``Taps.noise_var`` stays 1, the correlator cannot know.
    sample_rate_hz : bounds fall on samples as in a `SampleCorrelator`; None: continuous time.
    noise : False leaves the mean only.

    Raises
    ------
    ValueError : shapes that disagree, symbols that do not cover the truth; when called, a command
        outside the truth, a chip rate that is not positive, integrations that are not multiples of
        the period.
    """

    def __init__(
        self,
        state: SignalState,
        chips: np.ndarray | Replicas | Correlations,
        prn: np.ndarray,
        offset_chips: np.ndarray,
        seed: int,
        *,
        symbol_chips: int | np.ndarray = 20_460,
        period_chips: int | np.ndarray | None = None,
        multiple_access: bool = False,
        sample_rate_hz: float | None = None,
        noise: bool = True,
    ) -> None:
        self.offset_chips = np.ascontiguousarray(offset_chips, dtype=np.float64)
        if self.offset_chips.ndim != 1 or not np.all(np.abs(self.offset_chips) <= 1e9):
            raise ValueError(
                f"offset_chips is {offset_chips}: expected (n_tap,) of at most 1e9 in size"
            )
        n_channel = state.valid.shape[0]
        own = correlations_of(chips)
        if len(own.first) != n_channel or np.shape(prn) != (n_channel,):
            raise ValueError(
                f"chips of {len(own.first)} channels and prn {np.shape(prn)}: expected one for "
                f"each of the {n_channel} channels of the truth"
            )
        symbol_chips = np.broadcast_to(np.asarray(symbol_chips, np.int64), (n_channel,)).copy()
        check_symbols(state, symbol_chips)
        whole = own.period // own.per_chip if period_chips is None else period_chips
        self._period_chips = np.broadcast_to(np.asarray(whole, np.int64), (n_channel,))
        self._truth = truth_table(state, multiple_access, own.kept)
        self._symbols = np.ascontiguousarray(state.symbols, dtype=np.int8)
        facts = [symbol_chips, own.first, own.period, own.per_chip, prn, self._period_chips]
        factor = [tap_factor(own, i, self.offset_chips) for i in range(n_channel)]
        key0, key1 = stream_key(seed, "correlator-noise") if noise else (0, 0)
        n_tap = self.offset_chips.size
        # few arrays: each costs a compiled call 0.1 us
        numbers = [n_tap, int(state.first_symbol), int(key0), int(key1), int(noise)]
        position = np.zeros(4 * n_channel, np.int64)
        self._whole = np.concatenate([numbers, position, *facts], dtype=np.int64, casting="unsafe")
        self._fixed = np.concatenate([self.offset_chips, np.ravel(factor), own.table])
        self._opened = np.zeros(2 + n_channel * (3 + 2 * n_tap))
        self._opened[:2] = math.nan, 0.0 if sample_rate_hz is None else 1.0 / sample_rate_hz

    def __call__(self, nco: Nco) -> Taps:
        """Correlate over all pieces of the command; return the integrations that ended."""
        sound, whole, real, iq = _correlate(
            *nco, self._truth, self._symbols, self._fixed, self._whole, self._opened
        )
        if not sound:
            raise ValueError(self._refusal(nco))
        return Taps(
            whole[0], whole[1], real[0], real[1], iq, real[2], real[3], real[4], real[5], real[6]
        )

    def _refusal(self, nco: Nco) -> str:
        """Say what is wrong with a command that the compiled step has refused."""
        low, high = float(self._truth[0, 0, 0]), float(self._truth[-1, 0, 1])
        first_s, end_s = float(nco.t_s[0]), float(nco.t_s[-1])
        if not low - _TIME_TOLERANCE_S <= first_s <= end_s <= high + _TIME_TOLERANCE_S:
            return (
                f"nco.t_s runs from {first_s} to {end_s} s: expected inside the truth, "
                f"{low} to {high} s"
            )
        n_channel = self._truth.shape[1]
        shape = (nco.t_s.size - 1, n_channel)
        for array in nco[1:6]:
            if array.shape != shape:
                return f"a piece of nco is {array.shape}: expected {shape}"
        fits = nco.valid.shape == nco.dump_chips.shape == (n_channel,)
        if not fits or np.any(
            nco.valid & ((nco.dump_chips < 1) | (nco.dump_chips % self._period_chips > 0))
        ):
            whole = ", ".join(map(str, np.unique(self._period_chips)))
            return (
                f"nco.dump_chips is {nco.dump_chips}: expected ({n_channel},) with positive "
                f"multiples of {whole} where nco.valid, also ({n_channel},), is set"
            )
        return _what_is_wrong(nco)


def _what_is_wrong(nco: Nco) -> str:
    """Say which number of a valid channel cannot be run."""
    for name in Nco._fields[1:6]:
        values = getattr(nco, name)[:, nco.valid]
        most = 0.5 * FAR if "phase" in name else _FAST / 3.0
        far = ~(np.abs(values) <= most)
        if far.any():
            return (
                f"nco.{name} of a valid channel is {values[far][0]}: expected at most {most:.2g} "
                "in size"
            )
    return f"nco.chip_rate_hz is {nco.chip_rate_hz[:, nco.valid].min()}: expected > 0"


# ---- kernels ---------------------------------------------------------------------------------

# columns of a channel's position: is the index known, is a sum open, index, length
_KNOWN, _OPEN, _INDEX, _DUMP = 0, 1, 2, 3
_FAST = 1e10  # rates of a command: more would not fit the integers of sums, see `FAR`
_CHIP_TOLERANCE = 1e-6  # in continuous time a code phase this little past a multiple is at it


@kernel
def _correlate(
    t_s: np.ndarray, code: np.ndarray, chip_rate: np.ndarray, carrier: np.ndarray,
    freq: np.ndarray, freq_rate: np.ndarray, dump_chips: np.ndarray, valid: np.ndarray,
    truth: np.ndarray, symbols: np.ndarray, fixed: np.ndarray, whole: np.ndarray,
    opened: np.ndarray,
) -> tuple[bool, np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """All channels over one command -> channel and number, the other rows of `Taps`, iq.

    False first, and nothing done, where the command cannot be run.
    """
    nco = Nco(t_s, code, chip_rate, carrier, freq, freq_rate, dump_chips, valid)
    n, n_tap = truth.shape[1], whole[0]
    position = whole[5 : 5 + 4 * n].reshape((n, 4))
    facts = whole[5 + 4 * n :].reshape((6, n))
    sound, most = _most_dumps(nco, truth, facts[5])
    finished = np.empty((2, most), np.int64)
    real = np.empty((7, most))
    iq = np.empty((most, n_tap), np.complex128)
    n_dump = 0
    if sound:
        if not abs(t_s[0] - opened[0]) <= _TIME_TOLERANCE_S:
            position[:, _KNOWN] = 0
        opened[0] = t_s[t_s.size - 1]
        after = n_tap + n * n_tap * n_tap
        factor = fixed[n_tap:after].reshape((n, n_tap, n_tap))
        data = (symbols, whole[1], facts[0])
        replicas = (fixed[:n_tap], fixed[after:], facts[1], facts[2], facts[3])
        noise = (whole[4] > 0, whole[2], whole[3], facts[4], factor)
        start = opened[2 : 2 + 3 * n].reshape((n, 3))
        sums = opened[2 + 3 * n :].reshape((n, 2 * n_tap))
        rows = (finished, real, iq, np.zeros(2 * n_tap))
        n_dump = _all_channels(
            nco, truth, data, replicas, noise, (position, start, sums), opened[1], rows
        )
    return sound, finished[:, :n_dump], real[:, :n_dump], iq[:n_dump]


@borrowing
def _all_channels(
    replica: Any, truth: np.ndarray, data: Any, replicas: Any, noise: Any, state: Any,
    sample_s: float, rows: Any,
) -> int:  # fmt: skip
    """`_correlate` into given rows; returns their number."""
    t_s, code, chip_rate, carrier, freq, rate, dump_chips, valid = replica
    position = state[0]
    n = 0
    for i in range(valid.size):
        if not valid[i]:
            position[i, _KNOWN] = 0
            continue
        for p in range(t_s.size - 1):
            a, b = edge(t_s[p], sample_s), edge(t_s[p + 1], sample_s)
            if a < b:
                line = (t_s[p], code[p, i], chip_rate[p, i], carrier[p, i], freq[p, i], rate[p, i])
                _align(i, a + 0.5 * sample_s, line, dump_chips[i], sample_s, state)
                n = _over_piece(
                    i, a, b, line, truth, data, replicas, noise, state, sample_s, rows, n
                )
    return n


@borrowing
def _most_dumps(nco: Nco, truth: np.ndarray, period_chips: np.ndarray) -> tuple[bool, int]:
    """Can the command be run?  Bound on the integrations that can end."""
    t_s, code, chip_rate, carrier, freq, rate, dump_chips, valid = nco
    n_piece, n = t_s.size - 1, truth.shape[1]
    low = truth[0, 0, 0] - _TIME_TOLERANCE_S
    high = truth[truth.shape[0] - 1, 0, 1] + _TIME_TOLERANCE_S
    fits = valid.size == n and dump_chips.size == n and low <= t_s[0] <= t_s[n_piece] <= high
    for array in (code, chip_rate, carrier, freq, rate):
        fits = fits and array.shape[0] == n_piece and array.shape[1] == n
    if not fits:
        return False, 0
    most = 0.0
    for i in range(n):
        if valid[i]:
            if dump_chips[i] < 1 or dump_chips[i] % period_chips[i] > 0:
                return False, 0
            fastest = 0.0
            for p in range(n_piece):
                phases = abs(code[p, i]) + abs(carrier[p, i])
                rates = chip_rate[p, i] + abs(freq[p, i]) + abs(rate[p, i])
                if not (phases <= FAR and rates <= _FAST and chip_rate[p, i] > 0.0):
                    return False, 0
                fastest = max(fastest, chip_rate[p, i])
            most += 2.0 * n_piece + fastest * (t_s[n_piece] - t_s[0]) / dump_chips[i]
    return True, int(most)


@borrowing
def _align(i: int, t: float, line: Any, dump: int, sample_s: float, state: Any) -> None:
    """At a piece's first instant: keep the integration under way, or find it and maybe open it."""
    position = state[0]
    x, _ = replica_at(line, t)
    middle = (position[i, _INDEX] + 0.5) * dump
    if position[i, _KNOWN] and position[i, _DUMP] == dump and abs(x - middle) <= dump:
        return
    tolerance = GUARD_SAMPLES * sample_s * line[2] if sample_s > 0.0 else _CHIP_TOLERANCE
    index = math.floor((x + tolerance) / dump)
    position[i, _KNOWN] = 1
    position[i, _OPEN] = 0
    position[i, _INDEX] = index
    position[i, _DUMP] = dump
    if x - index * dump < max(line[2] * sample_s - tolerance, tolerance):
        _start(i, index, t, line, state)


@borrowing
def _over_piece(
    i: int, a: float, b: float, line: Any, truth: np.ndarray, data: Any, replicas: Any,
    noise: Any, state: Any, sample_s: float, rows: Any, n: int,
) -> int:  # fmt: skip
    """Channel i over [a, b), one piece of the command, cut at the bounds of integrations.

    Returns the number of rows written so far.
    """
    position, _, sums = state
    while True:
        target = (position[i, _INDEX] + 1) * position[i, _DUMP]
        at = line[0] + (target - line[1]) / line[2]
        cut = max(edge(at, sample_s), a)
        if position[i, _OPEN]:
            integrate(i, a, min(cut, b), line, truth, data, replicas, sums, sample_s)
        if cut >= b:
            return n
        t = cut + 0.5 * sample_s
        if position[i, _OPEN]:
            n = _finish(i, t, line, truth, noise, state, rows, n)
        _start(i, position[i, _INDEX] + 1, t, line, state)
        a = cut


@borrowing
def _start(i: int, index: int, t: float, line: Any, state: Any) -> None:
    """Empty the sums of channel i; t is their first instant."""
    position, start, sums = state
    position[i, _OPEN] = 1
    position[i, _INDEX] = index
    start[i, 0] = t
    start[i, 1], start[i, 2] = replica_at(line, t)
    for k in range(sums.shape[1]):
        sums[i, k] = 0.0


@borrowing
def _finish(
    i: int, t: float, line: Any, truth: np.ndarray, noise: Any, state: Any, rows: Any, n: int
) -> int:
    """Write the sums of channel i, which end at t, as row n; returns the next row."""
    position, start, sums = state
    noisy, key0, key1, prn, factor = noise
    whole, real, iq, draw = rows
    length = t - start[i, 0]
    if length <= 0.0:
        return n
    if noisy:
        first_chip = position[i, _INDEX] * position[i, _DUMP]
        normals(
            key0, key1, first_chip & 0xFFFFFFFF, (first_chip >> 32) & 0xFFFFFFFF,
            position[i, _DUMP], prn[i] << 16, draw,
        )  # fmt: skip
    gain = math.sqrt(2.0 / length)
    spread = truth[truth_piece(truth, i, t), i, SPREAD]
    for k in range(iq.shape[1]):
        re, im = 0.0, 0.0
        for m in range(k + 1):
            re += factor[i, k, m] * draw[2 * m]
            im += factor[i, k, m] * draw[2 * m + 1]
        iq[n, k] = complex(
            gain * sums[i, 2 * k] + spread * re, gain * sums[i, 2 * k + 1] + spread * im
        )
    whole[0, n], whole[1, n] = i, position[i, _INDEX]
    real[0, n], real[1, n], real[2, n] = start[i, 0], t, 1.0
    real[3, n], real[5, n] = start[i, 1], start[i, 2]
    real[4, n], real[6, n] = replica_at(line, t)
    return n + 1
