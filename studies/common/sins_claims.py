"""What Guo, Liu, Shi & Sun claim of ACEKF, and what came out."""

from __future__ import annotations

from collections.abc import Sequence

from common.ledger import Claim, Must, Quantity
from common.sins_cells import Merits
from common.sins_flight import KINDS, LARGE
from common.sins_measures import POSITION, VELOCITY, averaged, gain, peaks
from common.statistics import number

PAPER = "Guo et al., conclusions"
CLAIMED = {"EKF": 95.6, "REKF": 44.5, "AEKF": 24.6}
ORDER = "windows T1 and accelerometers of this project's choice"


def improvements(m: dict[str, Merits]) -> list[Claim]:
    """The three "at least"."""
    why = {
        "EKF": "the EKF's errors grow with the anomalies, ACEKF's do not: the number tells how "
        "strong they are",
        "REKF": "with windows of one length both estimate the same covariance",
        "AEKF": "one weight for all channels costs little where all are disturbed alike",
    }
    claims = []
    for over, bound in CLAIMED.items():
        names = (over,) if over == "EKF" else (over, f"{over} 50")
        for name in names:
            long = name.endswith("50")
            claims.append(Claim(
                id=f"acekf-over-{name.replace(' ', '-').lower()}",
                claim=f"ACEKF is better than {over} by at least {bound} %"
                + (f", whose window is 50 (ACEKF's is 10): {name}" if long else ""),
                source=PAPER,
                theirs=f"{bound} %",
                ours=(
                    gain(m, "T1 ar", name, True, Must("above", bound)),
                    *(gain(m, cell, name, False) for cell in (f"T1 {k}" for k in KINDS)),
                    gain(m, "BASE ar", name, True),
                ),
                why=why[over],
                change=ORDER + (", baseline's window of 50" if long else ""),
            ))  # fmt: skip
    return claims


def windows(m: dict[str, Merits]) -> list[Claim]:
    """What is said of detector and windows."""
    acekf = {kind: m[f"T1 {kind} ACEKF"] for kind in KINDS}
    small = [w for w in range(6) if w not in LARGE]

    def shares(part: Sequence[int], of: int, bound: float) -> tuple[Quantity, ...]:
        return tuple(
            averaged(f"{kind}, least share of class {'AB'[of == 1]} in windows "
                     f"{', '.join(str(w + 1) for w in part)}", a["classes"][:, part, of], "",
                     Must("above", bound), "min")
            for kind, a in acekf.items()
        )  # fmt: skip

    def worst(name: str, cell: str, part: Sequence[int], must: Must | None) -> Quantity:
        values = m[f"{cell} {name}"]["window_rmse"][:, part, POSITION].max(axis=2)
        return averaged(f"{cell}, {name}: least of the windows' position RMSE", values, "m", must,
                        "min")  # fmt: skip

    return [
        Claim("acekf-detector", "Most epochs of windows 1 and 4 are class A, of 2, 3, 5, 6 class B",
              PAPER, "stated, no number", (*shares(LARGE, 2, 0.5), *shares(small, 1, 0.5)),
              "so the sizes of the anomalies were chosen", ORDER),
        Claim("acekf-holds-velocity", "ACEKF holds 0.5 m/s in all windows", PAPER, "0.5 m/s",
              tuple(averaged(f"{kind}, largest error", peaks(a, VELOCITY), "m/s",
                             Must("below", 0.5)) for kind, a in acekf.items()),
              "the INS carries velocity over a window; a constant anomaly is believed in the end",
              ORDER),
        Claim("acekf-holds-position", "ACEKF holds 10 m in all windows", PAPER, "10 m",
              tuple(averaged(f"{kind}, largest error", peaks(a, POSITION), "m", Must("below", 10.0))
                    for kind, a in acekf.items())
              + tuple(averaged(f"{kind}, RMSE of a channel, all epochs", a["twelve"][:, 9:], "m")
                      for kind, a in acekf.items()),
              "the first fixes of a class B window enter unweighted; true of the RMSE where "
              "anomalies vary", ORDER),
        Claim("acekf-rekf-diverges", "REKF leaves 10 m in windows 1, 2, 4 and 5", PAPER,
              "shown, no number",
              tuple(worst(n, f"T1 {kind}", (0, 1, 3, 4), Must("above", 10.0) if n == "REKF" and
                          kind == "bias" else None)
                    for kind in ("ar", "bias") for n in ("REKF", "REKF 50")),
              "in one of these windows at least it stays within 10 m",
              ORDER),
        Claim("acekf-aekf-diverges", "AEKF leaves 10 m in window 5", PAPER, "shown, no number",
              (worst("AEKF", "T1 ar", (4,), Must("above", 10.0)), worst("AEKF 50", "T1 ar", (4,),
               None), worst("AEKF", "T1 bias", (4,), None)),
              "a window of 50 or a constant anomaly makes it worse", ORDER),
        Claim("acekf-aekf-over-rekf", "AEKF is better than REKF", PAPER, "stated, no number",
              tuple(gain(m, f"T1 {kind}", "REKF", False, Must("above", 0.0, "low"), "AEKF")
                    for kind in KINDS),
              "true of constant anomalies alone", ORDER),
        Claim("acekf-present-out", "Leaving the present residual out of the window is better",
              f"{PAPER[:11]}, (42)", "stated, no number",
              tuple(gain(m, f"T1 {kind}", "ACEKF, present in", False, Must("above", 0.0, "low"))
                    for kind in KINDS),
              "the first fix of a class B window then has the weight of a good one", ORDER),
        Claim("acekf-chi-square", "ACEKF is better than leaving out what fails a chi-square test",
              "this project", "not compared there",
              tuple(gain(m, cell, "chi-square test", False, Must("above", 0.0, "low"))
                    for cell in (*(f"T1 {k}" for k in KINDS), "BASE ar", "none")),
              "anomalies beyond 3 sigma hold no information while the INS is good to some metres "
              "over a window", ORDER),
    ]  # fmt: skip


def forms(m: dict[str, Merits], single: dict[float, dict[str, float]]) -> list[Claim]:
    """What UD brings."""
    double = number("double precision, largest difference of an output",
                    m["forms"]["off"].max(), Must("above", 1e-3), "m, m/s")  # fmt: skip
    ratios = tuple(
        number(f"single precision, R x {s:g}: error of sigma, {other} / UD",
               worst[f"{other}, single"] / worst["UD, single"], Must("above", 1.0))
        for s, worst in single.items() for other in ("Joseph", "short")
    )  # fmt: skip
    return [
        Claim("acekf-ud", "UD factorisation makes the filter more stable", PAPER, "stated",
              (double,), "nothing to rescue in double precision: both forms give the same figures"),
        Claim("acekf-ud-single", "UD factorisation makes the filter more accurate in single "
              "precision", PAPER, "stated", ratios, "it needs half of the digits",
              "single precision, covariance alone"),
    ]  # fmt: skip
