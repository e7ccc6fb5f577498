"""Sample-level correlator: each method, tap count, sampling rate and length of integration."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from benchmarks import baselines, peers
from benchmarks.harness import Case
from benchmarks.scene import N_CHANNEL, Scene, error, make
from signals import cpu
from signals.correlator import SampleCorrelator

TAPS = {3: np.array([-0.5, 0.0, 0.5]), 5: np.array([-1.0, -0.5, 0.0, 0.5, 1.0])}
TARGETS: dict[tuple[str, int], float] = {
    ("avx512", 3): 3.0, ("avx512", 5): 2.0, ("avx2", 3): 2.2, ("portable", 3): 1.0,
}  # fmt: skip
LIMIT = {3: 5.2}
"""Vector micro-operations of one 3.7 GHz core with AVX-512 (`peers.MACHINE`)"""
UNIT = "G channel-samples/s"


def groups() -> Iterator[tuple[str, list[Case]]]:
    """One group per scene: its methods take turns with the plain loops."""
    for fs in (4e6, 25e6):
        for dump_s in (0.001, 0.02):
            scene = make(fs, dump_s, 0.04 if fs < 2e7 else 0.02)
            title = f"correlator, {N_CHANNEL} channels, {fs / 1e6:g} Msps, {dump_s * 1e3:g} ms"
            yield title, _cases(scene, fs, dump_s)
    yield "correlator, Doppler rate", [_ramp()]


def _cases(scene: Scene, fs: float, dump_s: float) -> list[Case]:
    n_plain = round(0.002 * fs)
    cases = [
        Case(
            peers.YARDSTICK,
            lambda: baselines.plain_correlator(scene, TAPS[3], n_plain),
            N_CHANNEL * n_plain, UNIT, 1e-9,
        ),
        Case(
            "numpy, 3 taps", lambda: baselines.numpy_correlator(scene, TAPS[3], n_plain),
            N_CHANNEL * n_plain, UNIT, 1e-9,
        ),
    ]  # fmt: skip
    for n_tap in (3, 5):
        cases.append(
            _case(
                "exact", scene, n_tap,
                target=TARGETS.get((cpu.path(), n_tap)), error_target=2e-6,
                limit=LIMIT.get(n_tap) if cpu.path() == "avx512" else None,
                peer=peers.correlator(fs, dump_s, n_tap),
            )
        )  # fmt: skip
    if cpu.path() == "avx512":
        cases.append(_case("integer", scene, 3, target=4.8, error_target=0.012, limit=8.2))
        cases.append(_case("integer", scene, 5, error_target=0.012))
        if fs >= 2e7:
            cases.append(_case("binned", scene, 3, target=5.5, error_target=1e-3))
            cases.append(_case("binned", scene, 5, error_target=1e-3))
    return cases


def _case(method: Any, scene: Scene, n_tap: int, **given: Any) -> Case:
    correlator = SampleCorrelator(scene.recording, scene.chips, TAPS[n_tap], method=method)
    target = given.get("target")
    return Case(
        f"{method}, {n_tap} taps", lambda: correlator(scene.nco),
        N_CHANNEL * scene.duration_s * scene.fs, UNIT, 1e-9,
        baseline=peers.YARDSTICK,
        error=lambda: error(scene, correlator(scene.nco), TAPS[n_tap]),
        ratio_target=None if target is None else round(target / peers.PLAIN_GSPS),
        **given,
    )  # fmt: skip


def _ramp() -> Case:
    """1.3 kHz/s over 20 ms at 4 Msps: the error of following a bent phase in pieces."""
    scene = make(4e6, 0.02, rate_hz_per_s=1300.0)
    correlator = SampleCorrelator(scene.recording, scene.chips, TAPS[3])
    return Case(
        "exact, 3 taps, 1.3 kHz/s, 4 Msps, 20 ms", lambda: correlator(scene.nco),
        N_CHANNEL * scene.duration_s * scene.fs, UNIT, 1e-9,
        target=TARGETS.get((cpu.path(), 3)),
        error=lambda: error(scene, correlator(scene.nco), TAPS[3]), error_target=5e-5,
    )  # fmt: skip
