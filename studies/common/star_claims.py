"""What Fan, Zhao, Li, Tang & He claim of MMAE, and what came out."""

from __future__ import annotations

import numpy as np

from common.ledger import Claim, Must
from common.star_cells import BANKS, Merits
from common.star_flight import DURATION_S
from common.star_measures import excess, gain, scale, smaller
from common.statistics import number

PAPER, OURS = "Fan et al. 2014", "this project"
TABLE_2 = {
    "EKF": (0.00068013, 0.00082337, 0.00082276),
    "UKF": (0.00067563, 0.00081998, 0.00081969),
    "MMAE-EKF": (0.00067462, 0.00081934, 0.00081977),
    "MMAE-UKF": (0.0006742, 0.00081894, 0.00081898),
}
"""R.m.s. errors [rad] of heading, pitch and roll"""
ORDER = [1, 2, 0]
"""Of heading, pitch and roll among ours"""
FILLED = "star tracker of 10 arcsec at 10 Hz and bank of 0.25 to 2.5 of this project's choice"
DEG, AFTER = "misalignment in degrees", "r.m.s. after 50 s"


def of_the_table(m: dict[str, Merits]) -> list[Claim]:
    """What Table 2 and the conclusions say."""
    better = Must("above", 0.0, "low")
    deg, arcmin = m["deg UKF"], m["arcmin UKF"]
    alike = np.abs(np.sqrt(arcmin["settled"][:, 0] / m["arcmin EKF"]["settled"][:, 0]) - 1.0)
    over_all = smaller(np.stack([m[f"100 Hz {n}"]["all"] for n in ("MMAE-UKF", "EKF")],
                                axis=-1).swapaxes(0, 1))  # fmt: skip
    after = gain(m, "100 Hz", "MMAE-UKF", "EKF").value or np.nan
    pitch = m["100 Hz EKF"]["all"][:, 2].mean()
    start = 100.0 * np.radians(10.0) ** 2 / (DURATION_S * 100 + 1) / pitch
    ratio = [
        number(f"100 Hz, {name}, {angle}: ours / theirs", np.sqrt(found / theirs**2),
               Must("within", (0.98, 1.02)))
        for name, row in TABLE_2.items() if name in ("EKF", "MMAE-UKF")
        for angle, found, theirs in zip(("heading", "pitch", "roll"),
            m[f"100 Hz {name}"]["all"].mean(axis=0)[ORDER], row, strict=True)
    ]  # fmt: skip
    return [
        Claim("mmae-order", "Errors fall in the order EKF, UKF, MMAE-EKF, MMAE-UKF",
              f"{PAPER}, Table 2", "0.5 to 0.9 % from the first to the last", (
                  gain(m, "deg", "UKF", "EKF", better), gain(m, "deg", "MMAE-EKF", "UKF", better),
                  gain(m, "deg", "MMAE-UKF", "MMAE-EKF", better)),
              "the UKF wins where the first fix corrects 10 deg, the bank at all times",
              f"{DEG}, {AFTER}, {FILLED}"),
        Claim("mmae-ukf-arcmin", "The UKF is better than the EKF, misalignment in arc minutes",
              f"{PAPER}, Table 2", "0.4 to 0.7 %", (
                  number("largest difference of the r.m.s. in a flight", 100.0 * alike.max(),
                         Must("above", 0.1), "%"),),
              "h is linear to 1e-5 over 10 arcmin", f"{AFTER}, {FILLED}"),
        Claim("mmae-better", "MMAE is clearly better than a single filter", f"{PAPER}, conclusions",
              "stated; 0.1 to 0.8 % in Table 2", (
                  gain(m, "arcmin", "MMAE-EKF", "EKF", Must("above", 5.0, "low")),
                  gain(m, "deg", "MMAE-UKF", "UKF", Must("above", 5.0, "low"))),
              "Q is wrong by 2 in both halves", f"{AFTER}, floor of 1e-3, {FILLED}"),
        Claim("mmae-table-2", "The r.m.s. errors of Table 2", f"{PAPER}, Table 2",
              "6.7 to 8.2e-4 rad", tuple(ratio),
              "absolute values are not comparable: noise and rate of the star tracker are not"
              " stated", f"{DEG}, 100 Hz, {FILLED}"),
        Claim("mmae-table-2-shows", "R.m.s. errors over all epochs, as in Table 2, tell what a "
              "filter is worth", f"{PAPER}, Table 2", "differences of 0.5 to 0.9 %", (
                  *(number(f"100 Hz, MMAE-UKF over EKF, {angle}: gain over all epochs / after 50 s",
                           over_all[i] / after, Must("above", 0.5))
                    for i, angle in enumerate(("roll", "heading", "pitch"))),
                  gain(m, "100 Hz", "MMAE-UKF", "EKF"),
                  number("100 Hz, EKF: share of the start in the mean square of pitch", start,
                         unit="%")),
              "nearly all of it is the misalignment at the one epoch before the first fix, which "
              "all share", f"{DEG}, 100 Hz"),
        Claim("mmae-iterated", "The UKF is better than an EKF that iterates at the first fix", OURS,
              "not compared there", (gain(m, "deg", "UKF", "iterated EKF", better),),
              f"eight linearisations of one fix remove what the UKF wins"
              f" ({1e6 * np.sqrt(deg['settled'][:, 0].mean()):.2f} microrad)", DEG),
    ]  # fmt: skip


def of_the_bank(m: dict[str, Merits]) -> list[Claim]:
    """What is said of weights, parameters and points."""
    ten = gain(m, "arcmin", "MMAE-EKF", "EKF").value or 0.0
    others = tuple(
        number(f"{name}: gain less that of ten Hammersley points",
               (gain(m, "arcmin", name, "EKF").value or 0.0) - ten, unit="points")
        for name in BANKS
    )  # fmt: skip
    largest = max(abs(q.value or 0.0) for q in others)
    return [
        Claim("mmae-wgt", "The weighted mean of the models estimates the gyros' noise",
              f"{PAPER}, (6)", "stated, no number", (
                  scale(m, "arcmin MMAE-EKF", 500, Must("within", (0.4, 0.7))),
                  scale(m, "arcmin MMAE-EKF", 750, Must("within", (1.7, 2.3)))),
              "truth 0.5 up to 500 s, 2 then; points of the bank at 0.36, 0.59, 1.94 and 2.16",
              f"floor of 1e-3, {FILLED}"),
        Claim("mmae-wga", "It estimates the accelerometers' noise", f"{PAPER}, (6)",
              "stated, no number", (
                  number("weights, largest change when all models have one wga",
                         m["wga"]["off"][:, 0].max(), Must("above", 1e-3)),
                  number("attitude, the same", m["wga"]["off"][:, 1].max(), None, "rad")),
              "attitude in an inertial frame does not depend on specific force: that block is"
              " not observed, the second coordinate of the bank is idle"),
        Claim("mmae-as-printed", "Weights as printed follow the change at 500 s",
              f"{PAPER}, (3), (12)", "implied by the scenario", (
                  scale(m, "arcmin no floor", 600, Must("above", 1.7)),
                  scale(m, "arcmin no floor", 750), scale(m, "arcmin no floor", 1000),
                  gain(m, "arcmin", "no floor", "EKF"), scale(m, "deg no floor", 600)),
              "odds of 500 s must be undone first; from 10 deg the first fixes fix the weights for"
              " good.  A floor under the weights is the remedy", FILLED),
        Claim("mmae-points", "It matters how the bank's points are laid", f"{PAPER}, Fig. 3",
              "shown, no number", (
                  number("largest of those below, without sign", largest, Must("above", 1.0),
                         "points"), *others),
              "one coordinate counts, and there a Hammersley set is a grid", FILLED),
    ]  # fmt: skip


def of_ours(m: dict[str, Merits]) -> list[Claim]:
    """What the paper does not ask."""
    better = Must("above", 0.0, "low")
    return [
        Claim("mmae-oracle", "The bank is as good as a filter that is told Q, to half a point",
              OURS, "not compared there", (
                  excess(m, "arcmin", "MMAE-EKF", "true Q", Must("above", -0.5, "low")),
                  excess(m, "deg", "MMAE-UKF", "true Q, UKF", Must("above", -0.5, "low"))),
              "weights settle within seconds", "floor of 1e-3"),
        Claim("mmae-modes", "MMAE is better whatever Q means", OURS, "not compared there", (
                  gain(m, "arcmin", "MMAE-EKF", "EKF", better),
                  gain(m, "psd", "MMAE-EKF", "EKF", better),
                  gain(m, "rate", "MMAE-EKF", "EKF", better),
                  gain(m, "rate", "true Q", "EKF")),
              "as a rate per sample the noise is so small that the filter's memory is a minute:"
              " half of what there is to win is lost before the weights have settled",
              "floor of 1e-3"),
        Claim("mmae-floor", "Where the floor lies does not matter", OURS, "not compared there",
              tuple(excess(m, "arcmin", n, "MMAE-EKF", Must("above", -1.0))
                    for n in ("floor 1e-6", "floor 1e-2", "forgetting 0.999")),
              "it does not from 1e-6 to 1e-3; at 1e-2 the nine wrong models hold 8 % at all times;"
              " forgetting over 100 s takes as long to see the change", "in place of 1e-3"),
        Claim("mmae-wrong-r", "The bank finds Q where R is wrong", OURS, "not compared there", (
                  scale(m, "R x 4 MMAE-EKF", 500, Must("within", (0.4, 0.7))),
                  scale(m, "R x 4 MMAE-EKF", 750, Must("within", (1.7, 2.3))),
                  gain(m, "R x 4", "MMAE-EKF", "EKF")),
              "too large an R is made up for by a smaller Q: the gain is right, the estimate not",
              "R four times too large"),
    ]  # fmt: skip
