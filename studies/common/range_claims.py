"""What Duan, Gong, Xu & Zhao claim of ISHAKF, and what came out."""

from __future__ import annotations

import numpy as np

from common.ballistic_range import BURSTS_S, SETTLED, STEPS_S, jitter
from common.ledger import Claim, Must
from common.range_cells import LENGTHS, Group
from common.range_measures import (
    QUIET,
    after,
    agreement,
    burst_peaks,
    length_peak,
    never_back,
    ratio,
    removed,
    sooner,
    spaced,
    t80,
)
from common.statistics import count, mean, number

PAPER = "Duan et al."
CHANGED = "equations, motion and noise reconstructed"


def steps(m: dict[str, Group]) -> list[Claim]:
    """Definiteness, and the response to a noise that changes."""
    nominal, low = m["nominal"], m["low"]
    v2, v3 = nominal["V2"], nominal["V3"]
    lost = [number(f"epochs with an indefinite R^, {n}, both profiles",
                   float(sum(m[g][n].indefinite.sum() for g in ("nominal", "low"))),
                   Must("below", 0.0)) for n in ("V2", "V3", "V4")]  # fmt: skip
    up, down = np.array(STEPS_S)[[0, 2]], np.array(STEPS_S)[[1, 3]]
    rise = np.any([after(t, 0.0, 2.0) for t in up], axis=0)
    fall, later = (np.any([after(t, *w) for t in down], axis=0) for w in ((0.5, 2.0), (2.0, 4.0)))
    times = {name: t80(nominal[name]) for name in ("V2", "V3")}
    return [
        Claim(
            "ishakf-definite",
            "At low noise the innovation form of R^ loses definiteness, the residual form never",
            PAPER, "stated",
            (mean("V1, indefinite epochs of 2000", low["V1"].indefinite.astype(float), "",
                  Must("above", 50.0, "low")), *lost),
            "a square and a covariance against a difference; H P- H' exceeds R below 5 m of noise",
            CHANGED,
        ),
        Claim(
            "ishakf-jitter", "The noise estimate with adaptive forgetting jitters more", PAPER,
            "stated",
            (number("jitter V3 / V2", jitter(v3.sigma) / jitter(v2.sigma), Must("above", 1.0)),),
            f"{jitter(v3.sigma):.3f} against {jitter(v2.sigma):.3f}: b falls by chance too",
            CHANGED,
        ),
        Claim(
            "ishakf-rise", "After a sudden increase V3's noise estimate responds faster", PAPER,
            "stated",
            tuple(sooner(f"V3 later than V2, {t:.0f} s", v3, v2, j, Must("below", 0.0, "high"))
                  for j, t in ((0, 20.0), (2, 60.0))),
            f"80 % of the step in {spaced(times['V3'][[0, 2]])} s against "
            f"{spaced(times['V2'][[0, 2]])} s, mean of the runs", CHANGED,
        ),
        Claim(
            "ishakf-rise-state", "... and its position is slightly better at that moment", PAPER,
            "stated",
            (ratio("rms V3 / V2, 0-2 s after the rises", v3, v2, rise,
                   Must("below", 1.0, "high")),),
            "it rejects the first large samples for R^ and takes them for the state", CHANGED,
        ),
        Claim(
            "ishakf-fall", "After a sudden decrease V3 converges quickly, V2 slowly", PAPER,
            "stated",
            tuple(sooner(f"V3 later than V2, {t:.0f} s", v3, v2, j, Must("below", -1.0, "high"))
                  for j, t in ((1, 40.0), (3, 80.0))),
            f"80 % of the step in {spaced(times['V3'][[1, 3]])} s against "
            f"{spaced(times['V2'][[1, 3]])} s, mean of the runs", CHANGED,
        ),
        Claim(
            "ishakf-fall-state", "... and has the smaller error then", f"{PAPER}, Fig. 5", "shown",
            (ratio("rms V3 / V2, 0.5-2 s after the falls", v3, v2, fall,
                   Must("below", 1.0, "high")),
             ratio("2-4 s after", v3, v2, later), ratio("whole flight", v3, v2, SETTLED)),
            "the gain of the next seconds is lost again by an R^ that is too small", CHANGED,
        ),
    ]  # fmt: skip


def robust(m: dict[str, Group]) -> list[Claim]:
    """Outliers."""
    found = {name: burst_peaks(m["outliers"][name]) for name in ("V2", "V3", "V4")}
    lengths = {n: length_peak(m["length"][f"20 {n}"], n) for n in LENGTHS}
    base, wide = m["tuning"]["base"], m["tuning"]["c3 = 20, c4 = 30"]
    wet = [m["tuning"][f"{name} outliers"] for name in ("c3 = 20, c4 = 30", "base")]
    near = np.any([after(t, 0.0, 2.0) for t in BURSTS_S], axis=0)
    return [
        Claim(
            "ishakf-every-outlier",
            "Without the robust gain every outlier hurts, whatever the noise", PAPER, "stated",
            tuple(number(f"{n}, smallest mean peak of ten bursts", found[n].min(),
                         Must("above", 60.0), "m") for n in ("V2", "V3")),
            "V3 is worse than V2: it stops R^ from growing, and lets the state follow", CHANGED,
        ),
        Claim(
            "ishakf-removes", "ISHAKF removes outliers that are large against the noise, not "
            "comparable ones", PAPER, "stated",
            (number("V4, largest mean peak at 15-20 m", found["V4"][QUIET].max(),
                    Must("below", 30.0), "m"),
             number("V4, smallest at 60 m", found["V4"][~QUIET].min(), Must("above", 50.0), "m"),
             ratio("rms V4 / V2", m["outliers"]["V4"], m["outliers"]["V2"], SETTLED,
                   Must("below", 0.75, "high"))),
            "-200 m is beyond c4 = 16 only where sqrt(S) is below 35 m", CHANGED,
        ),
        Claim(
            "ishakf-long-bursts", "A long run of outliers pulls the filter over", PAPER, "stated",
            (mean("peak, 5 in a row, noise 20 m", lengths[5], "m", Must("below", 25.0, "high")),
             mean("10", lengths[10], "m"), mean("20", lengths[20], "m"),
             mean("40", lengths[40], "m", Must("above", 200.0, "low")),
             count("not back 20 s after the 40 began", never_back(m["length"]["20 40"]))),
            "P grows while nothing is taken, until eps of the outliers is below c4; then the state "
            "follows them with a velocity that takes it beyond, and comes back", CHANGED,
        ),
        Claim(
            "ishakf-c3", "A larger c3 adapts better and resists less", PAPER, "stated",
            (*(number(f"response to the rise at {t} s, c3 = 20 less c3 = 12",
                      t80(wide)[j] - t80(base)[j], Must("below", 0.0), "s")
               for j, t in ((0, 20), (2, 60))),
             ratio("rms within 2 s of the bursts, c3 = 20 / 12", *wet, near,
                   Must("above", 1.0, "low"))),
            "the band between c3 and c4 moves with it (c4 = 30)", CHANGED,
        ),
    ]  # fmt: skip


def measured(m: dict[str, Group]) -> list[Claim]:
    """What the paper found with a real missile, whose data it does not print."""
    change = f"{CHANGED}; noise of a surrogate, 38 to 190 m"
    share = [removed(m["missile"][f"{q} V4"]) for q in (10, 100)]
    plain = [removed(m["missile"][f"{q} V0"]) for q in (10, 100)]
    return [
        Claim(
            "ishakf-missile", "The random error of a missile's range data falls to 0.348",
            f"{PAPER}, missile", "122.1 -> 42.5 m",
            tuple(number(f"error / noise, q = {q}", s, Must("within", (0.28, 0.36)))
                  for q, s in zip((10, 100), share, strict=True)),
            "depends on Q and motion as much as on the filter", change,
        ),
        Claim(
            "ishakf-65", "ISHAKF removes more than 65 % of the random error", f"{PAPER}, missile",
            "> 65 %",
            tuple(number(f"removed, q = {q}", 100.0 * (1.0 - s), Must("above", 65.0), "%")
                  for q, s in zip((10, 100), share, strict=True)),
            "white noise at 20 Hz against a motion of 12 s", change,
        ),
        Claim(
            "ishakf-65-merit", "... and it is the adaptation that does it", f"{PAPER}, missile",
            "implied",
            tuple(number(f"error V4 / Kalman filter with R = (122.1 m)^2, q = {q}", s / p,
                         Must("below", 0.95))
                  for q, s, p in zip((10, 100), share, plain, strict=True)),
            "a fixed R of the mean size does the same", change,
        ),
        Claim(
            "ishakf-agreement", "Estimated and true noise agree", f"{PAPER}, missile",
            "extremely well",
            tuple(number(f"sigma^ / sigma, q = {q}", agreement(m["missile"][f"{q} V4"]),
                         Must("within", (0.9, 1.05))) for q in (10, 100)),
            "the residual form has the right fixed point; the lag of b = 0.97 is 1.7 s", change,
        ),
    ]  # fmt: skip
