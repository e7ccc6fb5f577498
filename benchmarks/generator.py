"""IF generator and noise."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from benchmarks import baselines, peers
from benchmarks.harness import Case
from benchmarks.scene import N_CHANNEL, Scene, make, signal_state
from signals import cpu
from signals.front_end import SyntheticIf
from signals.noise import complex_gaussian, stream_key
from signals.propagation import SignalState
from signals.vectors import body

UNIT = "G satellite-samples/s"
N_NOISE = 1_000_000
BEST = "avx512"


def groups() -> Iterator[tuple[str, list[Case]]]:
    """Satellites with and without noise at two rates; the noise alone."""
    for fs in (4e6, 25e6):
        yield f"generator, {N_CHANNEL} satellites, {fs / 1e6:g} Msps, int8", _cases(fs)
    yield "noise", _noise()


def _cases(fs: float) -> list[Case]:
    scene = make(fs, 0.02, 0.02)
    n_plain = round(0.002 * fs)
    state = signal_state(0.1)
    fast = cpu.path() == BEST
    return [
        Case(
            "plain loop, float64, no noise", lambda: baselines.plain_generator(scene, n_plain),
            N_CHANNEL * n_plain, UNIT, 1e-9,
        ),
        _case("no noise", scene, state, fs, False, 4.0 if fast else None),
        _case("AWGN, quantised", scene, state, fs, True, 2.4 if fast else None),
    ]  # fmt: skip


def _case(
    name: str, scene: Scene, state: SignalState, fs: float, noise: bool, target: float | None
) -> Case:
    source = SyntheticIf(state, scene.chips, fs, seed=1, noise=noise)
    n = source.end_sample - source.end_sample % 65_536
    return Case(
        name, lambda: source.samples(0, n), N_CHANNEL * n, UNIT, 1e-9, target,
        baseline="plain loop, float64, no noise", peer=peers.GENERATOR[round(fs / 1e6)],
    )  # fmt: skip


def _noise() -> list[Case]:
    key, rng = stream_key(1, "thermal"), np.random.default_rng(1)
    lanes, out = body(cpu.path()), np.empty((N_NOISE, 2), np.float32)
    return [
        Case(
            "numpy standard_normal, float32",
            lambda: rng.standard_normal(out=out, dtype=np.float32),
            N_NOISE, "M complex/s", 1e-6,
        ),
        Case(
            "Philox, complex Gaussian", lambda: complex_gaussian(lanes, key, 0, out), N_NOISE,
            "M complex/s", 1e-6, 600.0 if cpu.path() == BEST else None,
            baseline="numpy standard_normal, float32", peer=peers.NOISE,
        ),
    ]  # fmt: skip
