"""C/N0 from prompts: three estimators, and what each of them tends to.

With prompts P of T seconds, of amplitude A and unit noise in I and in Q, C/N0 = A^2 / (2 T).

    nwpr   narrow-wide power ratio of M prompts inside a data bit (Van Dierendonck, in Parkinson &
           Spilker, 1996, vol. I, ch. 8): mu = mean of |sum P|^2 / sum |P|^2,
           C/N0 = (mu - 1) / (M - mu) / T
    m2m4   second and fourth moments (Pauluzzi & Beaulieu, IEEE Trans. Commun. 48, 2000):
           S = sqrt(2 M2^2 - M4), C/N0 = S / (M2 - S) / T
    snv    signal to noise variance (same place): S = (mean |I|)^2, C/N0 = S / (M2 - S) / T

NWPR needs the edges of the data bits: without them there is no estimate.  M2M4 is blind to phase
and data, SNV to data but not to phase.  M2M4 has no answer where the moments of a finite sample
allow none; it is NaN then, not a wrong number.

What they tend to over many prompts (`limit_dbhz`): M2M4 the truth; SNV too much at low C/N0, as
noise alone has a mean |I|; NWPR too little, as the mean of a ratio is not the ratio of the means.
In a loop SNV takes phase jitter for noise: the variance grows from 1 to 1 + A^2 sigma^2 in Q.
"""

from __future__ import annotations

import math

import numpy as np

ESTIMATORS = ("nwpr", "m2m4", "snv")
_TERMS = 4000
"""Of the Poisson series, beyond any use: its mean is below 2000 up to 53 dB-Hz"""


def nwpr(prompts: np.ndarray, prompt_s: float, bit_prompts: int, first: int | None) -> np.ndarray:
    """C/N0 [dB-Hz] (...,) of prompts (..., n) by the narrow-wide power ratio; NaN for none.

    Parameters
    ----------
    prompts : (..., n) complex
        Successive ones.
    prompt_s
        Length of each.
    bit_prompts
        M, how many make a data bit.
    first : int or None
        The prompt that begins a data bit, counted from 0; None before bit synchronisation.  What
        is left over before it and at the end is not used.

    Raises
    ------
    ValueError
        Fewer than two prompts in a bit, a length that is not positive, ``first`` outside the bit.
    """
    z = _checked(prompts, prompt_s)
    m = bit_prompts
    if m < 2:
        raise ValueError(f"bit_prompts is {m}: expected 2 or more")
    if first is None:
        return np.full(z.shape[:-1], np.nan)
    if not 0 <= first < m:
        raise ValueError(f"first is {first}: expected 0 to {m - 1}, or None")
    n_bit = (z.shape[-1] - first) // m
    if n_bit < 1:
        return np.full(z.shape[:-1], np.nan)
    bits = z[..., first : first + n_bit * m].reshape(*z.shape[:-1], n_bit, m)
    wide = (bits.real**2 + bits.imag**2).sum(axis=-1)
    ratio = (np.abs(bits.sum(axis=-1)) ** 2 / np.where(wide > 0.0, wide, np.nan)).mean(axis=-1)
    return _dbhz((ratio - 1.0) / (m - ratio), prompt_s)


def m2m4(prompts: np.ndarray, prompt_s: float) -> np.ndarray:
    """C/N0 [dB-Hz] (...,) of prompts (..., n) by second and fourth moments; NaN for none."""
    z = _checked(prompts, prompt_s)
    power = z.real**2 + z.imag**2
    second = power.mean(axis=-1)
    return from_moments(second, (power**2).mean(axis=-1), prompt_s)


def snv(prompts: np.ndarray, prompt_s: float) -> np.ndarray:
    """C/N0 [dB-Hz] (...,) of prompts (..., n), phase-locked, by signal to noise variance."""
    z = _checked(prompts, prompt_s)
    second = (z.real**2 + z.imag**2).mean(axis=-1)
    signal = np.abs(z.real).mean(axis=-1) ** 2
    return _dbhz(signal / (second - signal), prompt_s)


def from_moments(second: np.ndarray, fourth: np.ndarray, prompt_s: float) -> np.ndarray:
    """M2M4 from the mean of |P|^2 and of |P|^4, any shape."""
    square = 2.0 * np.asarray(second) ** 2 - fourth
    signal = np.sqrt(np.where(square > 0.0, square, np.nan))
    return _dbhz(signal / (second - signal), prompt_s)


def limit_dbhz(estimator: str, cn0_dbhz: float, prompt_s: float, bit_prompts: int = 20) -> float:
    """What an estimator tends to over many prompts at a true C/N0, in lock [dB-Hz].

    nwpr: |sum P|^2 / M and the rest of sum |P|^2 are chi-square of 2 and 2 (M - 1) degrees, the
    first with the non-centrality M A^2, so that mu = M sum_j p_j (1 + j) / (M + j) with the Poisson
    weights p_j of mean M A^2 / 2.  snv: |I| is a folded normal.

    Raises
    ------
    ValueError
        An estimator that there is not.
    """
    if estimator not in ESTIMATORS:
        raise ValueError(f"estimator is {estimator!r}: expected one of {', '.join(ESTIMATORS)}")
    amplitude2 = 2.0 * 10.0 ** (cn0_dbhz / 10.0) * prompt_s
    if estimator == "m2m4":
        return float(cn0_dbhz)
    if estimator == "snv":
        amplitude = math.sqrt(amplitude2)
        folded = math.sqrt(2.0 / math.pi) * math.exp(-0.5 * amplitude2)
        folded += amplitude * math.erf(amplitude / math.sqrt(2.0))
        signal = folded**2
        return float(_dbhz(np.array(signal / (2.0 + amplitude2 - signal)), prompt_s))
    m, mean = bit_prompts, 0.5 * bit_prompts * amplitude2
    j = np.arange(_TERMS)
    log_factorial = np.concatenate([[0.0], np.cumsum(np.log(j[1:]))])
    weight = np.exp(j * math.log(mean) - mean - log_factorial)
    ratio = m * float(weight @ ((1.0 + j) / (m + j)))
    return float(_dbhz(np.array((ratio - 1.0) / (m - ratio)), prompt_s))


def _checked(prompts: np.ndarray, prompt_s: float) -> np.ndarray:
    z = np.asarray(prompts, dtype=np.complex128)
    if z.ndim < 1 or z.shape[-1] < 1:
        raise ValueError(f"prompts {z.shape}: expected (..., n) with one or more")
    if not (math.isfinite(prompt_s) and prompt_s > 0.0):
        raise ValueError(f"prompt_s is {prompt_s}: expected more than 0")
    return z


def _dbhz(ratio: np.ndarray, prompt_s: float) -> np.ndarray:
    """10 log10 of ratio / T, NaN where the ratio is not positive."""
    positive = np.where((ratio > 0.0) & np.isfinite(ratio), ratio, np.nan)
    return np.asarray(10.0 * np.log10(positive / prompt_s))
