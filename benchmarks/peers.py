"""What peers reach: measured beside us on one machine, or published by their authors.

`MACHINE` is where the peers were run, in November 2026; a ratio to them holds there only.  Nothing
of theirs is used here.
"""

from __future__ import annotations

MACHINE = "Xeon with AVX-512 at some 3.7 GHz, one core, thread CPU time, gcc 12 -O3"
"""Its own limits: 7.45 G AVX-512 FMA instructions/s, L1 270-410 GB/s, L2 170-190 GB/s"""

YARDSTICK = "plain loop, float64, 3 taps"
"""The case of `correlator` that says how fast this machine is at the moment"""
PLAIN_GSPS = 0.042
"""What it made there [G channel-samples/s]"""

_VOLK = {
    (4, 1, 3): 0.336, (4, 1, 5): 0.199, (4, 20, 3): 0.315,
    (25, 1, 3): 0.349, (25, 1, 5): 0.210, (25, 20, 3): 0.283,
}  # fmt: skip
_POCKET = {
    (4, 1, 3): 2.155, (4, 1, 5): 1.740, (25, 1, 3): 2.039, (25, 1, 5): 1.479,
    (4, 20, 3): 1.566, (25, 20, 3): 1.315,
}  # fmt: skip

GENERATOR = {4: "gps-sdr-sim 0.51, no noise", 25: "gps-sdr-sim 0.52, no noise"}
NOISE = "numpy float32 PCG64 62, SFC64 68"
FILTER = {6: "filterpy 20.8", 24: "filterpy 31.5"}


def correlator(fs: float, dump_s: float, n_tap: int) -> str:
    """Fastest exact and fastest approximate correlator of the open receivers [G/s]."""
    key = (round(fs / 1e6), round(dump_s * 1e3), n_tap)
    parts = []
    if key in _VOLK:
        parts.append(f"gnss-sdr (volk, float) {_VOLK[key]:.2f}")
    if key in _POCKET:
        parts.append(f"PocketSDR {_POCKET[key]:.2f} (4-bit, err 2-4e-2)")
    if key == (4, 1, 3):
        parts.append("Tracking.jl 0.87 (published, its machine)")
    return "; ".join(parts)
