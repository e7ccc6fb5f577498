"""Observations against orbits and clock from which the tracks were made."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from signals.constants import C_MPS, GPS_L1_HZ
from signals.propagation import pseudorange
from signals.satellites import embedded
from ultratight.tracking.from_samples import Tracks
from ultratight.tracking.observables import (
    Observations,
    missing_s,
    observe,
    start_guess_ms,
    sure_edges,
    telemetry,
)

START_MS = 475_220_000
PRNS = [2, 6, 17]


@pytest.fixture(scope="module")
def tracks(make_tracks: Callable[..., Tracks]) -> Tracks:
    """26 s; the clock is 4000 m ahead and drifts by 30 m/s."""
    return make_tracks(26.0, prns=PRNS, edge_off={6: 3, 17: -4})


@pytest.fixture(scope="module")
def seen(tracks: Tracks) -> Observations:
    right = sure_edges(tracks)
    return observe(right, telemetry(right), START_MS, 500)


def truth(place: np.ndarray, of: Observations) -> np.ndarray:
    """Pseudorange and its rate (n, m, 2)."""
    prns, rows = embedded().select(2149, 475_220.0)
    found = np.empty((len(of.t_s), len(of.prn), 2))
    for i, prn in enumerate(of.prn):
        row = rows[int(np.flatnonzero(prns == prn)[0])]
        for k, t in enumerate(of.t_s):
            b = 4000.0 + 30.0 * t
            found[k, i] = pseudorange(row, 475_220.0 + t, place, np.zeros(3), b, 30.0)[:2]
    return found


def test_pseudoranges_are_those_of_the_orbits(seen: Observations, place: np.ndarray) -> None:
    """To the 13 um of the tracks' chords; two channels' bit edges were 3 and -4 ms off."""
    expected = truth(place, seen)
    np.testing.assert_allclose(seen.pseudorange_m, expected[..., 0], atol=1e-4)
    np.testing.assert_array_equal(seen.tow_ms % 500, 0)
    np.testing.assert_allclose(seen.t_s, (seen.tow_ms - START_MS) / 1e3, atol=1e-9)
    travel = seen.tow_s[:, None] - expected[..., 0] / C_MPS
    np.testing.assert_allclose(seen.sent_s, travel, atol=1e-9)


def test_carrier_without_half_cycles_and_doppler(seen: Observations, place: np.ndarray) -> None:
    """Every second channel was tracked half a cycle off, as a Costas loop may."""
    expected = -truth(place, seen) * GPS_L1_HZ / C_MPS
    away = seen.carrier_cycles - expected[..., 0]
    np.testing.assert_allclose(away - np.rint(away), 0.0, atol=1e-3)
    np.testing.assert_allclose(seen.doppler_hz, expected[..., 1], atol=2e-3)
    assert np.abs(seen.cn0_dbhz - 45.0).max() < 0.6  # 0.15 dB in 1 s
    assert seen.restarted[0].all()
    assert not seen.restarted[1:].any()


def test_first_observation_follows_the_first_sure_time(seen: Observations) -> None:
    """Subframe 5 begins at 475224, is whole at 475230 and travels for 66 to 84 ms."""
    assert seen.tow_ms[0] == 475_230_500
    assert np.isfinite(seen.pseudorange_m).all()


def test_a_loss_of_lock_is_a_gap_until_the_next_handover_word(tracks: Tracks) -> None:
    events = [*tracks.events, (13.0, 0, "loss of lock", ""), (17.0, 0, "phase lock", "")]
    right = sure_edges(tracks._replace(events=events))
    seen = observe(right, telemetry(right), START_MS, 100)
    there = np.isfinite(seen.pseudorange_m[:, 0])
    # the subframe that begins at 475242 is the first after 17 s; its second word ends 1.2 s later
    expected = (seen.t_s < 13.0) | (seen.t_s > 22.0 + 1.2 + 0.066)
    assert np.flatnonzero(there != expected).size <= 1  # 84 ms or 66 ms of travel
    assert seen.restarted[:, 0].sum() == 2
    assert np.isfinite(seen.pseudorange_m[:, 1]).all()


def test_samples_that_are_missing_end_the_belief_in_time(tracks: Tracks) -> None:
    """A whole data bit is cut out of the prompts at 13 s, which no loop and no bit edge notices.

    475233 is in word 6 of subframe 1 (475230 to 475236), whose words take 0.6 s; what follows is
    late by a bit until the heads of two subframes have said so: 475241.98 and 475247.98 + 1.2 s.
    """
    right = sure_edges(tracks)
    own = np.flatnonzero(right.channel == 0)
    after = own[right.t_s[own] > 13.0]
    iq = right.iq.copy()
    iq[after[:-20]] = right.iq[after[20:]]
    cut = right._replace(iq=iq)
    told = telemetry(cut)
    found = missing_s(cut, told)
    assert list(found) == [PRNS[0]]
    assert found[PRNS[0]] == pytest.approx([13.0], abs=0.7)
    seen = observe(cut, told, START_MS, 100)
    there = np.isfinite(seen.pseudorange_m[:, 0])
    assert there[seen.t_s < 12.3].all()
    assert not there[(seen.t_s > 13.1) & (seen.t_s < 21.0)].any()
    assert missing_s(right, telemetry(right)) == {}


def test_guess_of_the_clock(tracks: Tracks) -> None:
    right = sure_edges(tracks)
    start_ms = start_guess_ms(right, telemetry(right))
    assert start_ms is not None
    assert abs(start_ms - START_MS) < 20
    short = right._replace(events=[])
    with pytest.raises(ValueError, match="interval_ms is 0: expected at least 1"):
        observe(short, telemetry(short), START_MS, 0)
    assert not len(observe(short, telemetry(short), START_MS, 100).t_s)
