"""IF samples at rest: what a source of samples is, and recordings in memory or in raw files."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal, Protocol

import numpy as np

SampleFormat = Literal["int8", "float32"]


class IfSource(Protocol):
    """Anything that has samples: `SyntheticIf`, `Recording`, or a user's own front end."""

    @property
    def sample_rate_hz(self) -> float:
        """Complex sampling rate."""
        ...

    @property
    def if_hz(self) -> float:
        """Frequency at which the nominal carrier appears."""
        ...

    @property
    def sigma(self) -> float:
        """Standard deviation of the noise in each of I and Q, in units of the samples."""
        ...

    def samples(self, n0: int, n1: int) -> np.ndarray:
        """Samples n0 <= n < n1 as (n1 - n0, 2) int8 or float32: I, Q."""
        ...


class Recording:
    """Recorded samples: an array or a raw file of interleaved I, Q; an `IfSource`.

    Parameters
    ----------
    source : (n, 2) int8 or float32, or the path of a raw little-endian file (memory-mapped).
    sample_rate_hz, if_hz, sigma : as in `IfSource`.
    sample_format : of a file.
    first_sample : number of the first recorded sample (sample n is taken at n / fs).

    Raises
    ------
    ValueError : a file that is missing, empty or truncated; from `samples`, a range outside it.
    """

    def __init__(
        self,
        source: np.ndarray | str | Path,
        sample_rate_hz: float,
        if_hz: float,
        sigma: float,
        *,
        sample_format: SampleFormat = "int8",
        first_sample: int = 0,
    ) -> None:
        if not (math.isfinite(sample_rate_hz) and sample_rate_hz > 0.0):
            raise ValueError(f"sample_rate_hz is {sample_rate_hz}: expected a positive rate")
        if not (math.isfinite(sigma) and sigma > 0.0):
            raise ValueError(f"sigma is {sigma}: expected a positive standard deviation")
        self.sample_rate_hz, self.if_hz = float(sample_rate_hz), float(if_hz)
        self.sigma = float(sigma)
        if isinstance(source, np.ndarray):
            self._name, self._data = "the recording", source
        else:
            self._name, self._data = str(source), _map_file(Path(source), sample_format)
        if (
            self._data.ndim != 2
            or self._data.shape[1] != 2
            or self._data.dtype
            not in (
                np.dtype(np.int8),
                np.dtype(np.float32),
            )
        ):
            raise ValueError(
                f"samples are {self._data.dtype} {self._data.shape}: expected (n, 2), int8 or "
                "float32"
            )
        self.dtype = self._data.dtype
        self.first_sample, self.end_sample = first_sample, first_sample + len(self._data)

    def samples(self, n0: int, n1: int) -> np.ndarray:
        """Samples n0 <= n < n1 as (n1 - n0, 2): I, Q.  A view, not to be written to."""
        check_range(n0, n1, self.first_sample, self.end_sample, self._name)
        return self._data[n0 - self.first_sample : n1 - self.first_sample]


def _map_file(path: Path, sample_format: SampleFormat) -> np.ndarray:
    dtype = np.dtype(sample_format).newbyteorder("<")
    pair = 2 * dtype.itemsize
    expected = f"expected interleaved I, Q of {sample_format}, {pair} bytes per sample"
    if not path.is_file():
        raise ValueError(f"{path} is missing: {expected}")
    size = path.stat().st_size
    if size == 0:
        raise ValueError(f"{path} is empty: {expected}")
    if size % pair:
        raise ValueError(f"{path} is truncated ({size} bytes): {expected}")
    return np.memmap(path, dtype, "r", shape=(size // pair, 2))


def check_range(n0: int, n1: int, first: int, end: int, name: str) -> None:
    """Raise ValueError unless first <= n0 <= n1 <= end."""
    if not first <= n0 <= n1 <= end:
        raise ValueError(f"samples {n0} to {n1} asked for: {name} has {first} to {end}")
