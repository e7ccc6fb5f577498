"""From tracks to positions, without samples: everything else as `ultratight track` does it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from signals.atmosphere import ionosphere_delay_m, troposphere_delay_m
from signals.propagation import elevation_azimuth
from signals.satellites import embedded
from ultratight.ins.earth import geodetic_from_ecef
from ultratight.tracking.from_samples import Tracks
from ultratight.tracking.navigation import navigate


def test_position_velocity_clock_of_a_drive(
    make_tracks: Callable[..., Tracks], place: np.ndarray
) -> None:
    """Subframes 1 to 3 end at 475248, 28 s after the start, and travel for 66 to 84 ms.

    The clock is 12 ms ahead: found to the millisecond, the rest is bias.
    """
    v = np.array([12.0, -5.0, 3.0])
    ahead = 12.25e-3 * 299_792_458.0
    tracks = make_tracks(29.5, v=tuple(v), clock_m=ahead, drift_mps=5.0, edge_off={17: 1})
    nav = navigate(tracks, atmosphere=False)
    assert nav.why_not == ""
    assert nav.week == 2149
    assert 28.06 < nav.possible_s < 28.2
    assert nav.positions[0].t_s == nav.possible_s
    assert len(nav.positions) > 10
    for p in nav.positions:
        assert p.fix is not None
        assert p.estimate is not None
        # the receiver's clock, wound back by 12 ms, reads 475219.988 + t, and is 0.25 ms ahead
        assert p.tow_s == pytest.approx(475_219.988 + p.t_s, abs=1e-9)
        here = place + v * p.t_s
        np.testing.assert_allclose(p.fix.state[:3], here, atol=0.01)
        bias = 0.25e-3 * 299_792_458.0 + 5.0 * p.t_s
        assert p.fix.state[3] == pytest.approx(bias, abs=0.01)
        np.testing.assert_allclose(p.fix.state[4:7], v, atol=1e-3)
        np.testing.assert_allclose(p.estimate.state[:3], here, atol=0.02)
        np.testing.assert_allclose(p.estimate.state[4:7], v, atol=1e-3)


def test_the_filter_is_nearer_than_single_fixes(
    make_tracks: Callable[..., Tracks], place: np.ndarray
) -> None:
    """1.2 m of code noise a channel, that of 45 dB-Hz: PDOP 1.5 times as much, less filtered."""
    nav = navigate(make_tracks(38.0, code_noise_m=1.2), atmosphere=False, interval_ms=500)
    late = [p for p in nav.positions if p.t_s > 31.0]
    fixes = np.array([p.fix.state[:3] for p in late if p.fix]) - place
    filtered = np.array([p.estimate.state[:3] for p in late if p.estimate]) - place
    assert len(fixes) == len(filtered) == len(late)
    rms, rms_filtered = (np.sqrt((e**2).sum(axis=1).mean()) for e in (fixes, filtered))
    pdop = late[0].fix.dop.position if late[0].fix else np.nan
    assert 0.5 < rms / (1.2 * pdop) < 1.5
    assert rms_filtered < 0.8 * rms


def test_the_message_corrects_for_the_ionosphere(
    make_tracks: Callable[..., Tracks], place: np.ndarray
) -> None:
    """Page 18 comes in the frame of 475260; delays are those of the models at the true place."""
    iono = embedded().iono_utc

    def delay(u: np.ndarray, r: np.ndarray, tow_s: float) -> np.ndarray:
        lat, lon, h = geodetic_from_ecef(r)
        elevation, azimuth = elevation_azimuth(r, u)
        late = ionosphere_delay_m(lat, lon, azimuth, elevation, tow_s, iono.alpha, iono.beta)
        return late + troposphere_delay_m(lat, h, elevation)

    tracks = make_tracks(35.0, tow_s=475_250.0, prns=[2, 6, 17, 19, 28], delay_m=delay)
    assert len(tracks.prn) == 5
    with_it = navigate(tracks, interval_ms=1000)
    without = navigate(tracks, atmosphere=False, interval_ms=1000)
    assert with_it.sky is not None
    assert with_it.sky.iono_utc.alpha == pytest.approx(iono.alpha, rel=1e-3)  # 8 bits each
    for nav, low, high in ((with_it, 0.0, 0.05), (without, 3.0, 200.0)):
        last = nav.positions[-1].fix
        assert last is not None
        assert low <= np.linalg.norm(last.state[:3] - place) < high


def test_what_is_missing_is_said(make_tracks: Callable[..., Tracks]) -> None:
    three = make_tracks(29.0, prns=[2, 6, 17])
    nav = navigate(three)
    assert nav.positions == []
    assert nav.why_not == "3 satellites with ephemeris and time of transmission, 4 are needed"
    short = three._replace(
        **{
            name: getattr(three, name)[three.t_s < 16.0]
            for name in (
                "channel", "period", "t_s", "iq", "doppler_hz", "code_phase_chips",
                "carrier_cycles",
            )
        }
    )  # fmt: skip
    nav = navigate(short)
    assert nav.why_not.startswith("no satellite's subframes 1 to 3 came whole")
    assert nav.observations is not None
    unlocked = navigate(short._replace(iq=0.0 * short.iq))
    assert unlocked.why_not.startswith("no handover word came whole")
    assert unlocked.observations is None
