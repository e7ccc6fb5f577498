"""Acquisition: 32 PRNs, +-5 kHz, 10 x 1 ms, against a plain search of the same cells."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from benchmarks import baselines
from benchmarks.harness import Case
from benchmarks.scene import N_CHANNEL, make
from signals.codes import GPS_L1CA
from ultratight.tracking import code_search
from ultratight.tracking.acquisition import Search, acquire

PRNS = range(1, 33)
PLAIN = "plain search, scipy.fft, complex64"


def groups() -> Iterator[tuple[str, list[Case]]]:
    """The scene of the correlator at its usual rate."""
    recording = make(4e6, 0.001).recording
    grid = Search().grid(recording, GPS_L1CA, 0)

    def surfaces() -> None:
        for _ in code_search.energies(recording, grid, PRNS):
            pass

    def wrong() -> float:
        """Number of satellites missed or made up."""
        found = {row.prn for row in acquire(recording) if row.found}
        return float(len(found ^ set(range(1, N_CHANNEL + 1))))

    same: dict[str, Any] = {"work": 1.0, "unit": "s", "scale": 1.0, "cost": True}
    yield (
        "acquisition, 32 PRNs, 21 Dopplers, 10 x 1 ms, 4 Msps",
        [
            Case(PLAIN, lambda: baselines.plain_search(recording, PRNS, 10), **same),
            Case("surfaces", surfaces, baseline=PLAIN, ratio_target=2.5, **same),
            Case(
                "satellites, fine estimates", lambda: acquire(recording), baseline=PLAIN,
                target=0.25, ratio_target=2.5, error=wrong, error_target=0.0,
                note="error: wrong PRNs", **same,
            ),
        ],
    )  # fmt: skip
