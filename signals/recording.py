"""IF samples at rest: what a source of samples is, and recordings in memory or in files.

A recording is a world without truth.  What its samples mean is said by five things: their format
(`sample_formats`), the sampling rate, the frequency at which the nominal carrier appears, the
order of I and Q, and the sign of Q.  A carrier above `if_hz` turns I + jQ counter-clockwise: where
a front end wrote Q first (``swap_iq``) or mixed with the other sideband (``conjugate``) the reader
puts that right, and ``if_hz`` is the frequency afterwards.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

import numpy as np

from signals.sample_formats import FileFormat, decode, file_format

_RATES_HZ = 1.0, 1e12
_LAST_SAMPLE = 2**53  # n / rate still tells one sample from the next
_MEASURED_BLOCKS, _MEASURED_SAMPLES = 64, 16_384


class IfSource(Protocol):
    """Anything that has samples: `SyntheticIf`, `Recording`, or a user's own front end."""

    @property
    def sample_rate_hz(self) -> float:
        """Sampling rate."""
        ...

    @property
    def if_hz(self) -> float:
        """Frequency at which the nominal carrier appears."""
        ...

    @property
    def sigma(self) -> float:
        """Standard deviation of the noise in each of I and Q, in units of the samples.

        Of real samples it is theirs divided by sqrt(2), as for their I and Q = 0 in the mean.
        """
        ...

    def samples(self, n0: int, n1: int) -> np.ndarray:
        """Samples n0 <= n < n1 as (n1 - n0, 2) int8 or float32: I, Q; real ones have Q = 0."""
        ...


class Recording:
    """Recorded samples: an array or a raw file; an `IfSource`.

    Real samples x are given as x + 0j, and sigma as the standard deviation of x over sqrt(2): half
    of the signal's power stays at +f, half of the noise falls on each of I and Q, so that the taps
    of a correlator are at the scale of complex samples, with the same C/N0.  The half at -f is
    noise to the correlator as long as 2 ``if_hz``, folded, is far from 0.

    Parameters
    ----------
    source : (n, 2) or (n,) int8, int16 or float32; or the path of a raw file (memory-mapped).
    sample_rate_hz, if_hz : as in `IfSource`.
    sigma : as in `IfSource`; None: measured, see `measured_sigma`.
    sample_format : of a file, see `sample_formats`.
    first_sample : number of the first recorded sample (sample n is taken at n / fs).
    n_samples : of a file; None: all that it holds.
    swap_iq : the file has Q before I.
    conjugate : the file has -Q in place of Q (int8's -128 becomes 127).

    Raises
    ------
    ValueError : a file that is missing, empty or truncated; from `samples`, a range outside it, a
        value that is not finite.
    """

    def __init__(
        self,
        source: np.ndarray | str | Path,
        sample_rate_hz: float,
        if_hz: float,
        sigma: float | None = None,
        *,
        sample_format: str = "ci8",
        first_sample: int = 0,
        n_samples: int | None = None,
        swap_iq: bool = False,
        conjugate: bool = False,
    ) -> None:
        where = "" if isinstance(source, np.ndarray) else f"{source}: "
        low, high = _RATES_HZ
        if not low <= sample_rate_hz <= high:
            raise ValueError(
                f"{where}sample_rate_hz is {sample_rate_hz}: expected {low:g} to {high:g} Hz"
            )
        if not abs(if_hz) <= sample_rate_hz / 2.0:
            raise ValueError(
                f"{where}if_hz is {if_hz}: expected at most half of {sample_rate_hz:g} Hz"
            )
        if sigma is not None and not 0.0 < sigma <= float(np.finfo(np.float32).max):
            raise ValueError(f"{where}sigma is {sigma}: expected a positive standard deviation")
        if not 0 <= first_sample < _LAST_SAMPLE:
            raise ValueError(f"{where}first_sample is {first_sample}: expected 0 to 2^53")
        self.sample_rate_hz, self.if_hz = float(sample_rate_hz), float(if_hz)
        if isinstance(source, np.ndarray):
            self.name = "the recording"
            self.format = _format_of(source)
            self._stored, n = source.reshape(-1), len(source)
        else:
            self.name = str(source)
            self.format = file_format(sample_format)
            self._stored, n = _map_file(Path(source), self.format, n_samples)
        if self.format.real and (swap_iq or conjugate):
            raise ValueError(f"{where}swap_iq, conjugate: real samples have no Q to swap or negate")
        self._swap, self._conjugate = swap_iq, conjugate
        self.first_sample, self.end_sample = first_sample, first_sample + n
        # int16 as float32: one set of compiled correlators fewer
        self.dtype = np.dtype(np.int8 if self.format.value_dtype == np.int8 else np.float32)
        as_stored = self.format.components == 2 and not (swap_iq or conjugate)
        as_stored = as_stored and self._stored.dtype == self.dtype
        self._pairs = np.asarray(self._stored).reshape(-1, 2) if as_stored else None
        self.sigma = measured_sigma(self) if sigma is None else float(sigma)

    def __len__(self) -> int:
        return self.end_sample - self.first_sample

    def samples(self, n0: int, n1: int) -> np.ndarray:
        """Samples n0 <= n < n1 as (n1 - n0, 2): I, Q.  Maybe a view, not to be written to."""
        check_range(n0, n1, self.first_sample, self.end_sample, self.name)
        if self._pairs is not None:
            return self._finite(self._pairs[n0 - self.first_sample : n1 - self.first_sample], n0)
        values = self._finite(self._values(n0 - self.first_sample, n1 - self.first_sample), n0)
        if self.format.real:
            out = np.zeros((len(values), 2), self.dtype)
            out[:, 0] = values[:, 0]
            return out
        values = values.astype(self.dtype, copy=False)
        if self._swap:
            values = values[:, ::-1]
        if self._conjugate:
            # int8 has no 128
            least = -127 if self.dtype == np.int8 else -np.inf
            values = np.stack([values[:, 0], -np.maximum(values[:, 1], least)], axis=1)
        return values.astype(self.dtype, copy=False)

    def _finite(self, values: np.ndarray, n0: int) -> np.ndarray:
        """The values (n, components) of samples from n0 on; ValueError: NaN or inf among them."""
        if values.dtype.kind == "f" and not np.isfinite(values.sum(dtype=np.float64)):
            bad = n0 + int(np.flatnonzero(~np.isfinite(values).all(axis=1))[0])
            raise ValueError(f"{self.name}: sample {bad} is not finite, expected numbers")
        return values

    def _values(self, a: int, b: int) -> np.ndarray:
        """Recorded values of samples a ... b - 1, (b - a, components), as they stand."""
        k, per_byte = self.format.components, self.format.per_byte
        first = a * k // per_byte
        values = decode(self._stored[first : -(-b * k // per_byte)], self.format)
        skipped = a - first * per_byte // k
        return values[skipped : skipped + b - a]

    def spread(self, blocks: int = _MEASURED_BLOCKS) -> Iterator[np.ndarray]:
        """The samples' values, (n, components), in blocks spread evenly over a long recording."""
        n, size = len(self), _MEASURED_SAMPLES
        if n <= blocks * size:
            yield self._values(0, n)
            return
        for a in np.linspace(0, n - size, blocks).astype(int).tolist():
            yield self._values(a, a + size)


def measured_sigma(recording: Recording) -> float:
    """Standard deviation about the mean, of I and Q together or of a real sample over sqrt(2).

    From at most 2^20 samples, spread evenly.  The satellites are in it: ten at 45 dB-Hz in 4 MHz
    add 4 %.  ValueError where all samples are equal.
    """
    count, total, square = 0, np.zeros(recording.format.components), 0.0
    for values in recording.spread():
        x = values.astype(np.float64)
        count += len(x)
        total += x.sum(axis=0)
        square += float(np.vdot(x, x))
    power = square / count - float(np.sum((total / count) ** 2))
    if not 0.0 < power < math.inf:
        raise ValueError(
            f"{recording.name}: samples are all equal or not finite, expected some of which a "
            "sigma can be measured"
        )
    return math.sqrt(power / 2.0)


def _format_of(source: np.ndarray) -> FileFormat:
    kind = {"int8": "i8", "int16": "i16", "float32": "f32"}.get(source.dtype.name)
    if kind and source.ndim == 2 and source.shape[1] == 2:
        return file_format(f"c{kind}")
    if kind and source.ndim == 1:
        return file_format(f"r{kind}")
    raise ValueError(
        f"samples are {source.dtype} {source.shape}: expected (n, 2) or (n,), int8, int16 or "
        "float32"
    )


def _map_file(path: Path, form: FileFormat, n_samples: int | None) -> tuple[np.ndarray, int]:
    """The bytes of a raw file as stored values, memory-mapped, and its number of samples."""
    order = "real" if form.real else "interleaved I, Q"
    expected = f"expected {order} samples of {form.name}, {form.bits} bits each"
    if not path.is_file():
        raise ValueError(f"{path}: no such file, {expected}")
    size = path.stat().st_size
    if size == 0:
        raise ValueError(f"{path}: empty, {expected}")
    if n_samples is None:
        n_samples, over = divmod(8 * size, form.bits)
        if over:
            raise ValueError(
                f"{path}: truncated, the sample that begins at byte {size - over // 8} of {size} "
                f"is not whole; {expected}"
            )
    elif form.n_bytes(n_samples) != size:
        raise ValueError(
            f"{path}: {size} bytes, expected {form.n_bytes(n_samples)} ({n_samples} samples of "
            f"{form.name}); {'truncated' if form.n_bytes(n_samples) > size else 'data follow'} "
            f"at byte {min(size, form.n_bytes(n_samples))}"
        )
    return np.memmap(path, form.dtype, "r"), n_samples


def check_range(n0: int, n1: int, first: int, end: int, name: str) -> None:
    """Raise ValueError unless first <= n0 <= n1 <= end."""
    if not first <= n0 <= n1 <= end:
        raise ValueError(f"samples {n0} to {n1} asked for: {name} has {first} to {end}")
