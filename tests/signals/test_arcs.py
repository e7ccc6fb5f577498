"""Orbits as polynomials, held against the full evaluation of the elements."""

import numpy as np
import pytest

from signals.arcs import ARC_S, N_ROW, arc_at, arc_index, arcs
from signals.satellites import ECC, embedded, orbit

TOW = 475_220.0
PRNS, ROWS = embedded().select(2149, TOW)

pytestmark = pytest.mark.nojit


def difference(rows, table, tow_s):
    """Arcs minus orbit at one time: position [m], velocity [m/s], clock [s], its rate (n, 8)."""
    arc = table[arc_index(table, tow_s)]
    middle = arc[N_ROW - 1, 0]
    by_arc = [arc_at(arc, i, tow_s - middle) for i in range(len(rows))]
    return np.array(by_arc) - [orbit(row, tow_s) for row in rows]


@pytest.mark.parametrize("start", [TOW, TOW - 5000.0])
def test_arcs_are_the_orbit_to_its_own_rounding(start):
    """Double precision holds 2.7e7 m to 4e-9 m, and the angles in `orbit` to some 1e-8 m."""
    span = 3.4 * ARC_S
    table = arcs(ROWS, start, start + span)
    assert table.shape == (4, N_ROW, len(ROWS))
    worst = np.zeros(8)
    for t in np.linspace(0.0, span, 41):
        worst = np.maximum(worst, np.abs(difference(ROWS, table, start + t)).max(axis=0))
    assert worst[:3].max() < 5e-8
    assert worst[3:6].max() < 1.5e-9
    assert worst[6] < 1e-18 + 2.0**-52 * 1e-3
    assert worst[7] < 1e-19


def test_a_second_beyond_the_ends_is_still_exact():
    """Light time and a receiver clock that is off reach a little out of an arc."""
    table = arcs(ROWS, TOW, TOW + ARC_S)
    for t in (-1.0, ARC_S + 1.0):
        worst = np.abs(difference(ROWS, table, TOW + t)).max(axis=0)
        assert worst[:3].max() < 5e-8
        assert worst[3:6].max() < 2e-9


def test_the_error_is_of_sixth_order():
    """h^6 x^(6) 4 / (27 720), at h (1 - t^2)^2 t^2 largest at t^2 = 1/3, seen on an orbit of
    e = 0.7 at perigee, where the sixth derivative is large."""
    row = ROWS[:1].copy()
    row[0, ECC] = 0.7
    perigee = TOW - 5000.0
    row[0, 4] = 0.0 - np.sqrt(3.986005e14 / row[0, 2] ** 6) * (perigee - row[0, 0])
    table = arcs(row, perigee - 0.5 * ARC_S, perigee + 0.5 * ARC_S)
    h = 0.5 * ARC_S
    t = h / np.sqrt(3.0)
    found = difference(row, table, perigee + t)[0, :3]
    # sixth derivative by central differences of the velocity, step 60 s
    step = 60.0
    v = np.array([orbit(row[0], perigee + k * step)[3:6] for k in (-3, -2, -1, 1, 2, 3)])
    fifth = (np.array([-1.0, 4.0, -5.0, 5.0, -4.0, 1.0])[:, None] * v).sum(axis=0) / (2 * step**5)
    expected = -fifth * h**6 * 4.0 / 27.0 / 720.0
    k = np.argmax(np.abs(expected))
    assert np.abs(expected[k]) > 1e-6
    assert found[k] == pytest.approx(expected[k], rel=0.1)


def test_bad_spans_are_refused():
    with pytest.raises(ValueError, match="rows has shape"):
        arcs(ROWS[:, :5], TOW, TOW + 1.0)
    with pytest.raises(ValueError, match="expected a finite span"):
        arcs(ROWS, TOW, TOW - 1.0)
    with pytest.raises(ValueError, match="expected a finite span"):
        arcs(ROWS, TOW, np.nan)
