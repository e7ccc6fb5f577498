"""How fast samples are made and correlated, against a plain float64 loop in the same run.

    python benchmarks/sample_level.py

CPU time of one thread, best of several; the ratio to the baseline holds when the machine is busy,
the absolute figures do not.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from numba import njit

import ultratight
from signals.correlator import SampleCorrelator
from signals.nco import Nco
from ultratight.world import World

REPEATS = 7
BLOCK_S = 0.1


@njit
def plain_correlator(samples, code, rate, carrier, freq, chips, offsets, fs, out):
    """The definition, sample by sample in float64, all channels and taps."""
    for i in range(chips.shape[0]):
        for n in range(samples.shape[0]):
            t = n / fs
            phase = -2.0 * np.pi * (carrier[i] + freq[i] * t)
            z = complex(samples[n, 0], samples[n, 1]) * complex(np.cos(phase), np.sin(phase))
            for k in range(offsets.size):
                chip = int(np.floor(code[i] + rate[i] * t - offsets[k])) % chips.shape[1]
                out[i, k] += z * chips[i, chip]


def best(work: Callable[[], object]) -> float:
    """Least CPU time of one call [s]."""
    work()
    times = []
    for _ in range(REPEATS):
        began = time.process_time()
        work()
        times.append(time.process_time() - began)
    return min(times)


def main() -> None:
    """Print a table."""
    scenario = ultratight.load("jump-1", {"duration_s": 2.0, "profile": []})
    world = World(scenario, seed=1)
    source, fs = world.samples, scenario.front_end.sample_rate_hz
    n = round(BLOCK_S * fs)
    samples = source.samples(0, n)
    state, n_channel = world.signal, world.prn.size
    code, carrier = state.code_phase_chips[:, 0], state.carrier_phase_cycles[:, 0]
    pieces = round(BLOCK_S / 0.02)
    t = np.arange(pieces + 1) * 0.02
    mid = t[:-1, None]
    nco = Nco(
        t,
        code[None, :, 0] + mid * code[None, :, 1],
        np.repeat(code[None, :, 1], pieces, axis=0),
        carrier[None, :, 0] + mid * carrier[None, :, 1],
        np.repeat(carrier[None, :, 1], pieces, axis=0),
        np.zeros((pieces, n_channel)),
        np.full(n_channel, 20_460),
        np.ones(n_channel, dtype=bool),
    )
    offsets = world.offset_chips
    recording = source.record(n)
    out = np.zeros((n_channel, offsets.size), dtype=np.complex128)
    plain = best(
        lambda: plain_correlator(
            samples,
            code[:, 0],
            code[:, 1],
            carrier[:, 0],
            carrier[:, 1],
            world.chips,
            offsets,
            fs,
            out,
        )
    )
    ours = best(lambda: SampleCorrelator(recording, world.chips, offsets)(nco))
    made = best(lambda: source.samples(0, n))
    work = n_channel * n
    print(f"{n_channel} satellites, {fs / 1e6:g} Msps, {offsets.size} taps, best of {REPEATS}")
    print(f"plain loop     {work / plain / 1e6:7.0f} M channel-samples/s   1")
    print(f"correlator     {work / ours / 1e6:7.0f} M channel-samples/s   {plain / ours:.1f}")
    print(f"generator      {work / made / 1e6:7.0f} M channel-samples/s   {plain / made:.1f}")
    for kind in ("model", "samples"):
        flown = scenario.replace({"correlator.kind": kind})
        cpu = best(lambda flown=flown: ultratight.run(flown, seed=1))
        print(f"whole run, {kind:8} {scenario.duration_s / cpu:6.1f} x real time on one thread")


if __name__ == "__main__":
    main()
