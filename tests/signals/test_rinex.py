"""RINEX navigation files: real ones, a round trip, and everything that can be wrong with them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from signals import satellites
from signals.rinex import read_navigation
from signals.satellites import Constellation, IonoUtc, embedded

DATA = Path(__file__).parents[3] / "shared" / "data" / "orbit"
needs_data = pytest.mark.skipif(
    not DATA.exists(), reason="needs the reference data folder beside the repository"
)

# Facts of the broadcast message of 2021-03-19: G03 and, to be skipped, E08 and the start of an R01
RINEX_3 = """\
     3.04           N: GNSS NAV DATA    M: Mixed            RINEX VERSION / TYPE
                                                            END OF HEADER
E08 2021 03 19 10 40 00  .603088719072D-02 -.568434188608D-11  .000000000000D+00
      .160000000000D+02 -.385000000000D+02  .351907515503D-08  .101772513154D+00
     -.172480940819D-05  .229118275456D-03  .670552253723D-05  .544061199188D+04
      .470400000000D+06 -.745058059692D-08 -.311318009565D+00 -.186264514923D-08
      .960931523981D+00  .200312500000D+03 -.457069705211D+00 -.565666419420D-08
     -.134648465792D-09  .516000000000D+03  .214900000000D+04  .000000000000D+00
      .312000000000D+01  .000000000000D+00 -.395812094212D-08 -.442378222942D-08
      .471604000000D+06  .000000000000D+00
G03 2021 03 19 12 00 00 -.112356152385D-03 -.105728759081D-10  .000000000000D+00
      .370000000000D+02 -.265625000000D+01  .456911889357D-08  .634492237240D+00
     -.396743416786D-06  .332982675172D-02  .693649053574D-05  .515363021851D+04
      .475200000000D+06 -.316649675369D-07 -.114852075735D+01  .521540641785D-07
      .968334075252D+00  .251343750000D+03  .830273530968D+00 -.808605110220D-08
      .331442377334D-09  .100000000000D+01  .214900000000D+04  .000000000000D+00
      .200000000000D+01  .000000000000D+00  .186264514923D-08  .370000000000D+02
      .471606000000D+06  .400000000000D+01
R01 2021 03 19 11 45 00  .1                -.1                  .1
"""


def written(tmp_path: Path, text: str, name: str = "test.nav") -> Path:
    path = tmp_path / name
    path.write_text(text)
    return path


@pytest.mark.nojit
def test_mixed_version_3(tmp_path):
    c = read_navigation(written(tmp_path, RINEX_3))
    assert (c.prn.tolist(), c.week.tolist(), c.health.tolist()) == ([3], [2149], [0])
    assert (c.iode.tolist(), c.transmission_s.tolist()) == ([37], [471_606.0])
    expected = {
        "TOE": 475200.0, "TOC": 475200.0, "SQRT_A": 5153.63021851, "ECC": 0.00332982675172,
        "M0": 0.63449223724, "DELTA_N": 4.56911889357e-9, "OMEGA0": -1.14852075735,
        "OMEGA_DOT": -8.0860511022e-9, "I0": 0.968334075252, "IDOT": 3.31442377334e-10,
        "OMEGA": 0.830273530968, "CUC": -3.96743416786e-7, "CUS": 6.93649053574e-6,
        "CRC": 251.34375, "CRS": -2.65625, "CIC": -3.16649675369e-8, "CIS": 5.21540641785e-8,
        "AF0": -1.12356152385e-4, "AF1": -1.05728759081e-11, "AF2": 0.0,
        "TGD": 1.86264514923e-9,
    }  # fmt: skip
    assert len(expected) == satellites.N_ELEMENT
    for name, value in expected.items():
        assert c.elements[0, getattr(satellites, name)] == value, name
    # and this is what the package carries
    own = embedded()
    (k,) = np.flatnonzero((own.prn == 3) & (own.elements[:, satellites.TOE] == 475_200.0))
    np.testing.assert_array_equal(own.elements[k], c.elements[0])
    assert own.transmission_s[k] == c.transmission_s[0]


def number(value: float, exponent: str = "D") -> str:
    return f"{value:19.12E}".replace("E", exponent)


def as_rinex(c: Constellation, version: int, exponent: str = "D") -> str:
    """Navigation file of a constellation, written by the format's tables A4 / A5."""
    from datetime import datetime, timedelta

    s = satellites
    system = "" if version == 2 else "G: GPS"
    kind = "N: GPS NAV DATA"
    lines = [
        f"{version + 0.04:9.2f}{'':11}{kind:20}{system:20}RINEX VERSION / TYPE",
        f"{'':60}END OF HEADER",
    ]
    for k in range(len(c)):
        e = c.elements[k]
        t = datetime(1980, 1, 6) + timedelta(weeks=int(c.week[k]), seconds=e[s.TOC])
        if version == 2:
            head = f"{c.prn[k]:2d} {t:%y %m %d %H %M} {t.second:4.1f}"
        else:
            head = f"G{c.prn[k]:02d} {t:%Y %m %d %H %M %S}"
        table = [
            [c.iode[k], e[s.CRS], e[s.DELTA_N], e[s.M0]],
            [e[s.CUC], e[s.ECC], e[s.CUS], e[s.SQRT_A]],
            [e[s.TOE], e[s.CIC], e[s.OMEGA0], e[s.CIS]],
            [e[s.I0], e[s.CRC], e[s.OMEGA], e[s.OMEGA_DOT]],
            [e[s.IDOT], c.status[k, s.CODE_ON_L2], c.week[k], c.status[k, s.L2P_OFF]],
            [2.0 + 0.8 * c.status[k, s.URA], c.health[k], e[s.TGD], c.status[k, s.IODC]],
            [c.transmission_s[k], 4.0 + 2.0 * c.status[k, s.FIT_INTERVAL]],
        ]
        clock = [e[s.AF0], e[s.AF1], e[s.AF2]]
        lines.append(head + "".join(number(x, exponent) for x in clock))
        lines += [" " * (version + 1) + "".join(number(x, exponent) for x in row) for row in table]
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("exponent", ["D", "E", "d", "e"])
def test_round_trip_of_the_embedded_constellation(tmp_path, version, exponent):
    own = embedded()
    back = read_navigation(written(tmp_path, as_rinex(own, version, exponent), "x.21n"))
    for name in ("prn", "week", "health", "iode", "transmission_s", "elements", "status"):
        np.testing.assert_array_equal(getattr(back, name), getattr(own, name), err_msg=name)
    assert own.status[:, satellites.URA].sum() == 1
    assert back.source == "x.21n"


def test_other_facts_of_a_set(tmp_path):
    own = embedded()
    status = np.tile([1023, 1, 3, 1, 1], (len(own), 1))
    back = read_navigation(written(tmp_path, as_rinex(replace(own, status=status), 3)))
    np.testing.assert_array_equal(back.status, status)
    # user range accuracy in metres to its index (IS-GPS-200 20.3.3.3.1.3); blanks at the end of
    # records, as some writers leave them: IODC of IODE
    text = RINEX_3.replace(
        "  .200000000000D+01  .000000000000D+00  .186", "{}  .000000000000D+00  .186"
    )
    for metres, index in ((0.0, 0), (2.0, 0), (2.4, 0), (2.8, 1), (4.0, 2), (5.7, 3), (8.0, 4),
                          (11.3, 5), (16.0, 6), (32.0, 7), (6144.0, 14), (8192.0, 15)):  # fmt: skip
        c = read_navigation(written(tmp_path, text.format(number(metres))))
        assert c.status[0].tolist() == [37, index, 1, 0, 0]
    text = RINEX_3.replace("  .186264514923D-08  .370000000000D+02", "  .186264514923D-08")
    assert read_navigation(written(tmp_path, text)).status[0].tolist() == [37, 0, 1, 0, 0]


def test_ionosphere_and_utc_of_both_versions(tmp_path):
    end = f"{'':60}END OF HEADER"
    # version 2: header of brdc1180.21n (IGS broadcast file of 2021-04-28)
    header = """\
    0.9313D-08  0.1490D-07 -0.5960D-07 -0.1192D-06          ION ALPHA
    0.8806D+05  0.4915D+05 -0.1311D+06 -0.3277D+06          ION BETA
   -0.279396772385D-08-0.266453525910D-14   503808     2155 DELTA-UTC: A0,A1,T,W
    18                                                      LEAP SECONDS
"""
    c = read_navigation(written(tmp_path, as_rinex(embedded(), 2).replace(end, header + end)))
    assert c.iono_utc == IonoUtc(
        alpha=(0.9313e-8, 0.1490e-7, -0.5960e-7, -0.1192e-6),
        beta=(0.8806e5, 0.4915e5, -0.1311e6, -0.3277e6),
        a0=-0.279396772385e-8,
        a1=-0.266453525910e-14,
        tot_s=503_808.0,
        week_t=2155,
        leap_s=18,
        leap_future_s=18,
    )
    # version 3: header of the embedded constellation's file, its Galileo lines passed over; the
    # UTC line is that of version 2 in the form of table A5
    header = """\
GPSA    .1118D-07   .7451D-08  -.5960D-07  -.5960D-07       IONOSPHERIC CORR
GPSB    .9011D+05   .0000D+00  -.1966D+06  -.6554D+05       IONOSPHERIC CORR
GAL     .4550D+02   .5859D-01   .2228D-02                   IONOSPHERIC CORR
GPUT -2.7939677238E-09-2.664535259E-15 503808 2155          TIME SYSTEM CORR
    18    18  2031     7                                    LEAP SECONDS
"""
    c = read_navigation(written(tmp_path, as_rinex(embedded(), 3).replace(end, header + end)))
    own = embedded().iono_utc
    utc = {"a0": -2.7939677238e-9, "a1": -2.664535259e-15, "tot_s": 503_808.0, "week_t": 2155}
    assert c.iono_utc == own._replace(**utc)
    assert read_navigation(written(tmp_path, as_rinex(embedded(), 3))).iono_utc == IonoUtc()
    bad = as_rinex(embedded(), 2).replace(
        end, header.replace("GPSA    .1118", "GPSA    .11x8") + end
    )
    with pytest.raises(
        ValueError, match=r"line 2: '\.11x8D-07' in columns 6-17: expected a number"
    ):
        read_navigation(written(tmp_path, bad, "bad.nav"))


@needs_data
@pytest.mark.parametrize(
    ("name", "n_set", "week", "sick"),
    [("brdc1180.21n", 105, 2155, []), ("brdc0010.22n", 422, 2190, None)],
)
def test_real_version_2_files(name, n_set, week, sick):
    c = read_navigation(DATA / name)
    # every record has 8 lines after the header
    lines = (DATA / name).read_text().splitlines()
    header = next(k for k, line in enumerate(lines) if "END OF HEADER" in line) + 1
    assert len(c) == n_set == (len(lines) - header) / 8
    assert set(c.week.tolist()) == {week}
    assert set(c.prn.tolist()) == set(range(1, 33))
    e = c.elements
    # 26 560 km, 55 deg: the constellation that IS-GPS-200 20.3.3.4.3 serves
    assert np.abs(e[:, satellites.SQRT_A] ** 2 - 26_560e3).max() < 20e3
    assert np.abs(np.degrees(e[:, satellites.I0]) - 55.0).max() < 2.5
    assert np.abs(e[:, satellites.TOC] - e[:, satellites.TOE]).max() <= 16.0
    if sick is not None:
        assert np.unique(c.prn[c.health != 0]).tolist() == sick
    else:
        assert (c.health != 0).any()
        prns = c.select(week, 540_000.0)[0]
        assert not set(prns) & set(c.prn[c.health != 0].tolist())


def test_weeks_are_those_of_toe(tmp_path):
    # clock epoch in the last seconds of week 2148, toe at the start of week 2149; the week field
    # may be modulo 1024 (2149 = 101) or blank
    text = RINEX_3.replace("G03 2021 03 19 12 00 00", "G03 2021 03 13 23 59 44")
    text = text.replace("      .475200000000D+06", "      .000000000000D+00")
    for stated in (
        "  .214900000000D+04",
        "  .214800000000D+04",
        "  .101000000000D+03",
        " " * 19,
    ):
        galileo, _, gps = text.partition("G03")
        gps = gps.replace("  .214900000000D+04", stated.rjust(19))
        c = read_navigation(written(tmp_path, galileo + "G03" + gps))
        assert c.week.tolist() == [2149]
        assert c.elements[0, satellites.TOE] == 0.0
        assert c.elements[0, satellites.TOC] == -16.0
    wrong = written(tmp_path, text.replace(".214900000000D+04", ".210000000000D+04"))
    with pytest.raises(ValueError, match=r"line 16: week 2100 does not belong .* \(week 2149\)"):
        read_navigation(wrong)


def test_two_digit_years_and_unknown_transmission(tmp_path):
    own = embedded()
    text = as_rinex(own, 2)
    old = text.replace(" 3 21 03 19 12 00  0.0", " 3 99 08 20 00 00  0.0", 1)
    assert old != text
    old = old.replace(" 4.752000000000D+05", " 4.320000000000D+05").replace(
        number(471_606.0), number(0.9999e9)
    )
    old = old.replace(number(2149.0), " " * 19)
    c = read_navigation(written(tmp_path, old))
    (k,) = np.flatnonzero(c.week == 1023)  # 1999-08-20 is a Friday of the week before the rollover
    assert c.prn[k] == 3
    assert c.elements[k, satellites.TOC] == 432_000.0
    assert c.transmission_s[k] == 432_000.0 - 7200.0


def replaced(old: str, new: str) -> str:
    assert RINEX_3.count(old) >= 1
    return RINEX_3.replace(old, new)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"^bad\.nav: the file is empty, expected a RINEX navigation file$"),
        ("\n\n", r"^bad\.nav: the file is empty"),
        ("PNG\n", r"^bad\.nav, line 1: 'PNG': expected a RINEX header"),
        (replaced("     3.04 ", "     4.00 "), r"line 1: RINEX version '4.00': expected 2 or 3"),
        (
            replaced("N: GNSS NAV DATA", "OBSERVATION DATA"),
            r"line 1: file type 'OBSERVATION DATA': expected N",
        ),
        (replaced("END OF HEADER", "COMMENT"), r"line 19: .* expected END OF HEADER"),
        (RINEX_3.partition("G03")[0], r"^bad\.nav: no GPS ephemeris in the file"),
        (
            RINEX_3.partition("      .471606")[0],
            r"line 17: the file ends in a record, expected 8 lines",
        ),
        (
            replaced("G03 2021 03 19", "G03 2021 13 19"),
            r"line 11: 'G03 2021 13 19 12 00 00': expected PRN, year month day",
        ),
        (replaced("G03 2021", "G3x 2021"), r"line 11: 'G3x 2021 .* expected PRN, year"),
        (
            replaced(".332982675172D-02", ".33298x675172D-02"),
            r"line 13: '.33298x675172D-02' in columns 24-42: expected a number",
        ),
        (replaced("  .968334075252D+00", " " * 19), r"line 15: '' in columns 5-23: expected a num"),
        (replaced(".515363021851D+04", ".515363021851D+03"), r"line 13: sqrt\(A\) = 515.363: exp"),
        (replaced(".332982675172D-02", ".332982675172D+02"), r"line 13: eccentricity = 33.2983"),
        (replaced(".475200000000D+06", ".675200000000D+06"), r"line 14: toe = 675200: expected 0"),
        (replaced(" " * 6 + ".968334", "G04   .968334"), r"line 15: 'G04 .*: expected line 5 of a"),
        (replaced("R01 2021", "%01 2021"), r"line 19: '%01 2021.*expected the first line of a rec"),
    ],
)
def test_damaged_files_are_refused_with_file_line_and_expectation(tmp_path, text, message):
    with pytest.raises(ValueError, match=message):
        read_navigation(written(tmp_path, text, "bad.nav"))


def test_binary_and_missing_files(tmp_path):
    path = tmp_path / "iq.bin"
    path.write_bytes(bytes(range(256)) * 4)
    with pytest.raises(ValueError, match=r"iq\.bin, line 1: .*expected a RINEX header"):
        read_navigation(path)
    with pytest.raises(FileNotFoundError):
        read_navigation(tmp_path / "none.nav")
