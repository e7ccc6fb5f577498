"""The GPS LNAV message: bits from broadcast ephemerides, and ephemerides from bits.

IS-GPS-200 appendix II.  What is sent is what a receiver decodes: elements rounded to the message's
steps, which broadcast ephemerides (RINEX files) already are.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from signals import satellites as s
from signals.constants import WEEK_S
from signals.lnav_fields import (
    IONOSPHERE_UTC,
    PAGE_ID,
    SUBFRAME_1,
    SUBFRAME_2,
    SUBFRAME_3,
    from_elements,
    into_elements,
    pack,
    unpack,
)
from signals.lnav_pages import IONOSPHERE_UTC_PAGE, Pages
from signals.lnav_words import (
    BIT_S,
    FRAME_S,
    SUBFRAME_BITS,
    SUBFRAME_S,
    Subframe,
    encode_subframe,
    find_subframes,
    with_telemetry_and_handover,
)
from signals.satellites import MAX_AGE_S, Constellation, IonoUtc

_NO_AODO = 31  # 20.3.3.4.4: no correction table to be used


def lnav_bits(
    constellation: Constellation, prn: int, week: int, tow_s: float, n_bits: int
) -> np.ndarray:
    """Bits as one satellite transmits them.

    A frame carries the set of `Constellation.select` at its start; the satellite therefore changes
    sets at the frame nearest to the middle between two toe.

    Parameters
    ----------
    constellation
        Ephemerides, ionosphere and UTC parameters.
    prn
        Satellite, 1 to 32.
    week, tow_s
        GPS week (full) and time of week at which the first bit leaves the satellite by its own
        clock, a multiple of 20 ms [s]; before and past the week's ends is allowed.
    n_bits
        Number of bits.

    Returns
    -------
    (n_bits,) int8 of +-1, logical 0 is +1.

    Raises
    ------
    ValueError
        A time that is no bit edge, a PRN without LNAV, no healthy set for the time, or an element
        outside its field.
    """
    if not 1 <= prn <= 32:
        raise ValueError(f"prn = {prn}: expected 1 to 32, the satellites with LNAV almanac pages")
    edge = tow_s / BIT_S
    if not (math.isfinite(edge) and abs(edge - round(edge)) < 1e-6):
        raise ValueError(f"tow_s = {tow_s!r}: expected a bit edge, a multiple of 0.02 s")
    if n_bits < 0:
        raise ValueError(f"n_bits = {n_bits}: expected 0 or more")
    first = round(edge)
    begin, end = first // SUBFRAME_BITS, -(-(first + n_bits) // SUBFRAME_BITS)
    pages = Pages(constellation)
    parts = [_subframe(constellation, pages, prn, week, k) for k in range(begin, end)]
    bits = np.concatenate([np.empty(0, np.int8), *parts])
    skip = first - begin * SUBFRAME_BITS
    return (1 - 2 * bits[skip : skip + n_bits]).astype(np.int8)


def decode_navigation(
    bits: Mapping[int, np.ndarray], near_week: int, source: str = "LNAV"
) -> Constellation:
    """Read the ephemerides out of received bits.

    Parameters
    ----------
    bits
        By PRN, (n,) of +-1 beginning anywhere, upright or inverted.
    near_week
        GPS week within 511 weeks of the true one: the message has ten bits of it.
    source
        Name for the result.

    Returns
    -------
    Every set that came whole (subframes 1-3 with one issue of data), once; transmission_s is the
    start of the subframe that completed it first.  Ionosphere and UTC parameters as last received.

    Raises
    ------
    ValueError
        There is no whole set.
    """
    return constellation_of({p: find_subframes(x) for p, x in bits.items()}, near_week, source)


def constellation_of(
    received: Mapping[int, Sequence[Subframe]], near_week: int, source: str = "LNAV"
) -> Constellation:
    """`decode_navigation` of the whole subframes of each PRN, in the order of their reception."""
    sets: dict[tuple[int, int, int, float], tuple[int, float, np.ndarray, dict[str, int]]] = {}
    iono_utc = IonoUtc()
    for prn, subframes in received.items():
        for week, sent, row, facts in _ephemerides(subframes, near_week):
            key = prn, facts["iodc"], week, float(row[s.TOE])
            sets.setdefault(key, (week, sent, row, facts))
        iono_utc = _iono_utc(subframes, near_week) or iono_utc
    if not sets:
        raise ValueError(f"{source}: no satellite's subframes 1 to 3 came whole")
    found = list(sets.values())
    status = [[f[n] for n in _STATUS] for *_, f in found]
    return Constellation(
        prn=np.array([key[0] for key in sets], dtype=np.int64),
        week=np.array([week for week, *_ in found], dtype=np.int64),
        elements=np.array([row for _, _, row, _ in found]),
        health=np.array([f["health"] for *_, f in found], dtype=np.int64),
        iode=np.array([f["iode"] for *_, f in found], dtype=np.int64),
        transmission_s=np.array([sent for _, sent, _, _ in found]),
        source=source,
        status=np.array(status, dtype=np.int64),
        iono_utc=iono_utc,
    )


_STATUS = ("iodc", "ura", "code_on_l2", "l2p_off", "fit_interval")  # the columns of `status`


def _subframe(sky: Constellation, pages: Pages, prn: int, week: int, count: int) -> np.ndarray:
    """Bits (0 and 1) of subframe ``count`` since the start of ``week``."""
    weeks, tow_s = divmod(count * SUBFRAME_S, WEEK_S)
    week += int(weeks)
    number = count % 5 + 1
    frame_s = tow_s - SUBFRAME_S * (number - 1)
    if number <= 3:
        data = _ephemeris_data(sky, prn, week, frame_s)[number - 1]
    else:
        data = pages.data(pages.page_id(number, frame_s))
    return encode_subframe(with_telemetry_and_handover(data, number, tow_s))


def _ephemeris_data(
    sky: Constellation, prn: int, week: int, frame_s: float
) -> tuple[int, int, int]:
    """Words 3 to 10 of subframes 1 to 3 of the frame that begins at ``frame_s``."""
    # the frame under way when a set's two hours begin or end carries it
    index = sky.choose(week, frame_s, prn, MAX_AGE_S + FRAME_S)
    if index < 0:
        raise ValueError(sky.refusal(week, frame_s, prn))
    row = sky.elements[index].copy()
    row[[s.TOE, s.TOC]] %= WEEK_S
    try:
        numbers = [from_elements(f, row) for f in (SUBFRAME_1, SUBFRAME_2, SUBFRAME_3)]
    except ValueError as error:
        raise ValueError(f"{sky.source}, G{prn:02d}: {error}") from None
    facts = dict(zip(_STATUS, sky.status[index].tolist(), strict=True))
    # the lower bits of IODC are the IODE (20.3.3.4.1)
    facts |= {"week10": week % 1024, "health": int(sky.health[index]), "aodo": _NO_AODO}
    facts["iode"] = int(sky.iode[index]) & 0xFF
    facts["iodc"] = facts["iodc"] & 0x300 | facts["iode"]
    one, two, three = numbers
    return (
        pack(SUBFRAME_1, one | facts),
        pack(SUBFRAME_2, two | facts),
        pack(SUBFRAME_3, three | facts),
    )


def _ephemerides(
    subframes: Iterable[Subframe], near_week: int
) -> Iterable[tuple[int, float, np.ndarray, dict[str, int]]]:
    """Week of toe, transmission [s of it], elements and other numbers of each whole set."""
    last: dict[int, dict[str, int]] = {}
    tables = {1: SUBFRAME_1, 2: SUBFRAME_2, 3: SUBFRAME_3}
    for subframe in subframes:
        if subframe.number not in tables:
            continue
        last[subframe.number] = unpack(tables[subframe.number], subframe.data)
        if len(last) < 3 or not last[1]["iodc"] & 0xFF == last[2]["iode"] == last[3]["iode"]:
            continue
        facts = last[1] | last[2] | last[3]
        row = np.zeros(s.N_ELEMENT)
        for table in tables.values():
            into_elements(table, facts, row)
        sent = subframe.tow_s
        week = near_week + (facts["week10"] - near_week + 512) % 1024 - 512
        # toe and toc lie within half a week of the transmission
        shift = -_nearest_week(row[s.TOE] - sent)
        row[s.TOC] += WEEK_S * (-_nearest_week(row[s.TOC] - sent) - shift)
        yield week + shift, sent - WEEK_S * shift, row, facts


def _nearest_week(difference_s: float) -> int:
    return math.floor(difference_s / WEEK_S + 0.5)


def _iono_utc(subframes: Iterable[Subframe], near_week: int) -> IonoUtc | None:
    """Parameters of the last page 18 of subframe 4."""
    found = None
    for subframe in subframes:
        page_id = unpack(PAGE_ID, subframe.data)["page_id"]
        if subframe.number == 4 and page_id == IONOSPHERE_UTC_PAGE:
            found = unpack(IONOSPHERE_UTC, subframe.data)
    if found is None:
        return None
    v = {f.name: f.value(found[f.name]) for f in IONOSPHERE_UTC}
    return IonoUtc(
        alpha=(v["alpha0"], v["alpha1"], v["alpha2"], v["alpha3"]),
        beta=(v["beta0"], v["beta1"], v["beta2"], v["beta3"]),
        a0=v["a0"],
        a1=v["a1"],
        tot_s=v["tot_s"],
        week_t=near_week + (found["wn_t"] - near_week + 128) % 256 - 128,
        leap_s=found["leap_s"],
        week_lsf=near_week + (found["wn_lsf"] - near_week + 128) % 256 - 128,
        day=found["day"],
        leap_future_s=found["leap_future_s"],
    )
