"""What this machine runs: versions, the path of the kernels, their cache, and checks of them."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from llvmlite import binding
from numba.core import config as numba_config

from signals import compiled, cpu
from signals.codes import GPS_L1CA
from signals.constants import CA_CHIP_RATE_HZ
from signals.correlator import SampleCorrelator
from signals.front_end import SyntheticIf
from signals.nco import Nco
from signals.noise import complex_gaussian, philox, stream_key
from signals.propagation import SignalState
from signals.recording import Recording
from signals.reference import relative_error, samples_by_definition, taps_by_definition
from signals.vectors import Portable, body
from ultratight.provenance import versions

PHILOX_ZERO = (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)
"""Philox4x32-10 of counter and key zero: known answers of Salmon et al.'s Random123"""


class Check(NamedTuple):
    """One comparison with what is known to be right."""

    name: str
    error: float
    tolerance: float

    @property
    def passed(self) -> bool:
        """NaN does not pass."""
        return self.error <= self.tolerance


def examine() -> dict[str, Any]:
    """Everything that `ultratight doctor` prints, as plain values."""
    checks = list(_checks())
    return {
        "versions": versions(),
        "system": platform.platform(),
        "cpu": binding.get_host_cpu_name(),
        "cores": os.cpu_count(),
        "cpu_path": cpu.path(),
        "cpu_paths": ["python"] if numba_config.DISABLE_JIT else cpu.available(),
        "cache": _cache(),
        "checks": [check._asdict() | {"passed": check.passed} for check in checks],
        "healthy": all(check.passed for check in checks),
    }


def _cache() -> dict[str, Any]:
    """Where compiled kernels are kept, and whether they can be."""
    root = compiled.cache_root()
    files = list(root.rglob("*.nbc")) if root.is_dir() else []
    return {
        "folder": str(root),
        "writable": compiled.cache_is_writable(),
        "kernels": len(files),
        "megabytes": round(sum(path.stat().st_size for path in files) / 1e6, 1),
    }


def _checks() -> Iterator[Check]:
    for name, error, tolerance in cpu.check():
        yield Check(name, float(error), float(tolerance))
    words = philox(0, 0, 0, 0, 0, 0)
    wrong = sum(int(a) != b for a, b in zip(words, PHILOX_ZERO, strict=True))
    yield Check("Philox4x32-10, words unlike the published ones", float(wrong), 0.0)
    yield Check("generator against float64, exact index and phase", _generator_error(), 2e-6)
    yield Check("noise, samples unlike those of the plain path", _noise_difference(), 0.0)
    yield Check("correlator against float64, exact index and phase", _correlator_error(), 2e-6)


def _generator_error() -> float:
    """Two milliseconds of two satellites at 4.1 Msps and IF 0.3 MHz, without noise."""
    fs, if_hz, n = 4.1e6, 0.3e6, np.arange(8200)
    chips = np.stack([GPS_L1CA.chips(prn) for prn in (3, 31)])
    doppler = np.array([3300.0, -2700.0])
    code, carrier = np.zeros((2, 1, 4)), np.zeros((2, 1, 4))
    code[:, 0, 0], code[:, 0, 1] = (500.2, 19_800.7), CA_CHIP_RATE_HZ + doppler / 1540.0
    carrier[:, 0, 0], carrier[:, 0, 1], carrier[:, 0, 2] = 0.4, doppler, 150.0
    state = SignalState(
        np.array([0.0, n.size / fs]), code, carrier, np.full((2, 1), 45.0),
        np.ones((2, 1), np.bool_), np.array([[1, -1], [-1, 1]], np.int8), 0,
    )  # fmt: skip
    source = SyntheticIf(state, chips, fs, 1, if_hz=if_hz, sample_format="float32", noise=False)
    pairs = source.samples(0, n.size).astype(np.float64)
    wanted = samples_by_definition(state, list(chips), n, fs, if_hz)
    return relative_error(pairs[:, 0] + 1j * pairs[:, 1], wanted)


def _noise_difference() -> float:
    """How many of 8192 numbers differ in any bit."""
    key = stream_key(1, "doctor")
    here, plain = np.empty((4096, 2), np.float32), np.empty((4096, 2), np.float32)
    complex_gaussian(body(cpu.path()), key, 7 * 4096, here)
    complex_gaussian(Portable(), key, 7 * 4096, plain)
    return float((here.view(np.uint32) != plain.view(np.uint32)).sum())


def _correlator_error() -> float:
    """One millisecond of two satellites in noise at 4.1 Msps, summed anew sample by sample."""
    fs, n, offsets = 4.1e6, 4100, np.array([-0.5, 0.0, 0.3])
    rng = np.random.default_rng(7)
    samples = np.clip(np.rint(24.0 * rng.standard_normal((n, 2))), -127, 127).astype(np.int8)
    chips = np.stack([GPS_L1CA.chips(prn) for prn in (3, 31)])
    code, rate = np.array([0.2, 0.7]), CA_CHIP_RATE_HZ + np.array([2.1, -1.7])
    carrier, freq = np.array([0.1, 0.6]), np.array([3300.0, -2700.0])
    t_end = n / fs
    nco = Nco(
        np.array([0.0, t_end]), code[None], rate[None], carrier[None], freq[None],
        np.zeros((1, 2)), np.array([500, 500]), np.ones(2, dtype=np.bool_),
    )  # fmt: skip
    source = Recording(samples, fs, 0.0, 24.0)
    taps = SampleCorrelator(source, chips, offsets)(nco)
    return relative_error(taps.iq, taps_by_definition(source, list(chips), offsets, nco, taps))


def lines(told: dict[str, Any]) -> Iterator[str]:
    """What `examine` found, to be read."""
    made = ", ".join(f"{name} {number}" for name, number in told["versions"].items())
    yield f"versions   {made}"
    yield f"system     {told['system']}; {told['cores']} cores, {told['cpu']}"
    others = ", ".join(told["cpu_paths"])
    yield f"path       {told['cpu_path']} in use; this CPU has {others} ({cpu.VARIABLE})"
    cache = told["cache"]
    kept = f"{cache['kernels']} kernels, {cache['megabytes']:g} MB"
    if not cache["writable"]:
        kept = "cannot be written to: kernels are compiled anew in every process"
    yield f"cache      {cache['folder']}: {kept}"
    for check in told["checks"]:
        verdict = "ok   " if check["passed"] else "WRONG"
        error, tolerance = check["error"], check["tolerance"]
        yield f"{verdict}      {check['name']}: {error:.2g}, tolerance {tolerance:.2g}"
    yield (
        "healthy"
        if told["healthy"]
        else "NOT healthy: results of this machine are not to be trusted"
    )
