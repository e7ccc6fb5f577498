"""What the study `loop_theory` claims, from its flights and draws."""

from __future__ import annotations

import numpy as np
from snr_sweep import crossing

from common.ledger import Claim, Must, Quantity
from common.loop_cells import CLEAR_DB, LEAST_SLOPE, LEVELS, LOOPS, STRESS_CYCLES, Flown, Loop
from common.loop_samples import CURVE_SPACINGS, SLIP_DB, Curves, PhaseCurves, Slips
from common.statistics import interval, number
from ultratight.tracking import loop_theory as theory
from ultratight.tracking.discriminators import CODE_DISCRIMINATORS, PHASE_DISCRIMINATORS
from ultratight.tracking.loop_filters import BANDWIDTH_PER_W

KH, BK = "Kaplan & Hegarty, 3rd ed., ch. 8", "Betz & Kolodziejski 2009"
FIVE = Must("within", (0.95, 1.05))


def ratio(name: str, squares: np.ndarray, must: Must | None = None) -> Quantity:
    """Root of the mean of squares (run, ...); the bootstrap draws the first axis."""
    rest = tuple(range(-squares.ndim + 1, 0))

    def root(drawn: np.ndarray) -> np.ndarray:
        return np.asarray(np.sqrt(np.nanmean(drawn, axis=(rest[0] - 1, *rest) if rest else -1)))

    return interval(name, squares, root, "", must)


def clear(loop: Loop) -> list[int]:
    """Levels where linear theory is held to its word."""
    lowest = loop.threshold() + CLEAR_DB
    return [k for k, x in enumerate(LEVELS) if x >= lowest and loop.slope(x) >= LEAST_SLOPE]


def worst(name: str, flown: dict[str, Flown], which: str) -> Quantity:
    """The single cell that is farthest from theory."""
    cells = [
        (float(np.sqrt(np.nanmean(getattr(f, which)[:, k]))), loop, k)
        for loop, f in flown.items()
        for k in clear(LOOPS[loop])
    ]
    _, loop, k = max(cells, key=lambda cell: abs(np.log(cell[0])))
    return ratio(f"{name}, {loop} at {LEVELS[k]:g} dB-Hz", getattr(flown[loop], which)[:, k])


def near(flown: dict[str, Flown], which: str, loops: list[str]) -> list[Quantity]:
    """Ratios at the level next above the threshold, where theory is not expected to hold."""
    out = []
    for name in loops:
        k = next(k for k, level in enumerate(LEVELS) if level >= LOOPS[name].threshold())
        squares = getattr(flown[name], which)[:, k]
        if np.isfinite(squares).any():
            out.append(ratio(f"{name} at {LEVELS[k]:g} dB-Hz", squares[np.isfinite(squares)]))
    return out


def thermal(flown: dict[str, Flown]) -> list[Claim]:
    """Jitter of closed loops."""
    phase = [name for name, loop in LOOPS.items() if not loop.fll]

    def pooled(name: str, which: str) -> Quantity:
        return ratio(name, getattr(flown[name], which)[:, clear(LOOPS[name])], FIVE)

    where = f"C/N0 from {CLEAR_DB:g} dB above the threshold up to 50 dB-Hz"
    plls, flls = ({n: flown[n] for n in flown if LOOPS[n].fll == fll} for fll in (False, True))
    return [
        Claim(
            "loop-pll-jitter", f"PLL thermal jitter, {where}", KH,
            "sqrt(Bn / (C/N0) [1 + 1 / (2 T C/N0)]) rad, a pilot without the bracket: ratio 1",
            (*(pooled(n, "carrier") for n in phase), worst("worst cell", plls, "carrier"),
             *near(plls, "carrier", phase)),
            "Bn is that of the digital loop; near the threshold jitter grows beyond linear theory, "
            "and a pilot is lost at 24 dB-Hz where the rule says 15.6: 25 is not clear of it",
        ),
        Claim(
            "loop-dll-jitter", f"DLL thermal jitter, {where} of the carrier loop", f"{BK}; {KH}",
            "D / (2 C/N0) Bn and the squaring loss of each discriminator: ratio 1",
            (*(pooled(n, "code") for n in LOOPS), worst("worst cell", flown, "code"),
             *near(flown, "code", list(LOOPS))),
            "slope and noise are those of each code's own correlation; envelopes have no squaring "
            "loss in theory and bend as the arctangent does",
        ),
        Claim(
            "loop-fll-jitter", f"FLL thermal jitter, {where}", KH,
            "1 / (2 pi T) sqrt(4 Bn / (C/N0) [1 + 1 / (2 T C/N0)]) Hz: ratio 1",
            (*(pooled(n, "carrier") for n in flls), worst("worst cell", flls, "carrier"),
             *near(flls, "carrier", list(flls))),
            "pairs of prompts do not overlap, so that the bracket is half of the book's: "
            "1 / (2 T C/N0) for 1 / (T C/N0)",
            "squaring loss of the product itself",
        ),
    ]  # fmt: skip


def shot_claims(shots: dict[str, np.ndarray]) -> list[Claim]:
    """Open-loop variance, without filters' help."""

    def one(name: str, values: np.ndarray) -> Quantity:
        return ratio(name, values.mean(axis=(0, 1)), FIVE)

    flat = {n: v for n, v in shots.items() if "MHz" not in n}
    band = {n: v for n, v in shots.items() if "MHz" in n}
    told = "coherent, dot product and power at 20, 30, 50 dB-Hz, T = 10 ms"
    return [
        Claim(
            "loop-one-shot",
            f"Noise of one code discriminator output, wide band: {told}",
            BK,
            "ratio 1",
            tuple(one(n, v) for n, v in flat.items()),
            "A is known: no slope is lost at any C/N0; coherent ones lose signs below 20 dB-Hz; R "
            "of PRN 7 falls by 6 % less than the triangle over its "
            "first chip, hence 3 % less noise",
        ),
        Claim(
            "loop-one-shot-band",
            f"The same behind an ideal filter: {told}",
            f"{BK}, integrals",
            "ratio 1",
            tuple(one(n, v) for n, v in band.items()),
            "the filter shapes noise and signal alike; 20.46 MHz, 2.046 MHz, 4.092 MHz two-sided",
        ),
    ]


def stresses(flown: dict[str, Flown]) -> list[Claim]:
    """Error under a constant derivative."""
    names = list(LOOPS)
    own = tuple(
        interval(name, flown[name].stress, lambda x: x.mean(axis=-1), "", FIVE) for name in names
    )
    book = []
    for name in names:
        loop = LOOPS[name]
        hz, interval_s = loop.noise_bandwidth_hz, loop.settings.integration_s
        factor = (loop.w * BANDWIDTH_PER_W[loop.order] / hz) ** loop.order
        told = f"{name}, Bn T = {hz * interval_s:g}"
        book.append(interval(told, flown[name].stress / factor, lambda x: x.mean(axis=-1), "",
                             FIVE))  # fmt: skip
    return [
        Claim(
            "loop-stress",
            "Dynamic stress: acceleration / w^2, jerk / w^3 (FLL: w^2), w of the digital loop",
            KH, "ratio 1", own, "the number of integrators says what a loop follows",
        ),
        Claim(
            "loop-stress-book", "Dynamic stress with the table's w = Bn / 0.53 and Bn / 0.7845",
            KH, "18 Hz: 1.536 deg per g/s", tuple(book),
            "a digital loop of noise bandwidth Bn has a smaller w than the analogue one; w enters "
            "with its square or cube: the book is optimistic beyond Bn T of some hundredths",
        ),
    ]  # fmt: skip


def slip_claims(slips: Slips) -> list[Claim]:
    """Viterbi's first-order loop, and what higher orders do."""

    def quantity(order: int, db: float, must: Must | None) -> Quantity:
        seconds, n = slips[order, db]
        book = theory.mean_time_to_slip_s(10.0 ** (0.1 * db), 1.0)
        half = 1.96 / np.sqrt(n)  # slips are Poisson
        r = seconds / book
        return Quantity(f"order {order}, {db:g} dB", r, r * (1.0 - half), r * (1.0 + half), "",
                        must)  # fmt: skip

    return [
        Claim(
            "loop-slip",
            "Mean time to slip of a first-order Costas loop (I Q), Bn = 1 Hz",
            "Viterbi 1966",
            "7.91, 23.5, 136.6 s at a loop SNR of 0, 2, 4 dB: ratio 1",
            tuple(quantity(1, db, Must("within", (0.9, 1.1))) for db in SLIP_DB),
            "rho = 1 / (2 sigma)^2 of the doubled angle, squaring loss included; Bn T = 0.002, "
            "as a delay of 1.5 T acts like a loop SNR larger by 6 Bn T",
        ),
        Claim(
            "loop-slip-order",
            "Loops of order 2 and 3 slip as seldom as the first-order one",
            "Viterbi 1966, taken for any loop of that Bn",
            "ratio 1",
            tuple(quantity(k, db, Must("within", (0.9, 1.1))) for k in (2, 3) for db in SLIP_DB),
            "the integrators go on with the frequency that brought the slip about, and slips come "
            "in bursts",
        ),
    ]


def threshold_of(name: str, levels: np.ndarray, lost: np.ndarray, must: Must | None) -> Quantity:
    """Where a tenth of the channels is lost within ten seconds."""
    return interval(name, lost, lambda drawn: crossing(levels, drawn.mean(axis=-2)), "dB-Hz", must)


def thresholds(flown: dict[str, Flown]) -> list[Claim]:
    """The rule of 3 sigma, and the closure's indicators, against channels that are lost."""

    def near(book: float, half: float) -> Must:
        return Must("within", (round(book - half, 2), round(book + half, 2)))

    rule, ours, moved = [], [], []
    for name, loop in LOOPS.items():
        f, book = flown[name], loop.threshold()
        own = max(book, loop.indicator_threshold())
        rule.append(threshold_of(f"{name} (rule {book:.1f})", f.around, f.lost, near(book, 2.0)))
        ours.append(threshold_of(f"{name} (here {own:.1f})", f.around, f.lost, near(own, 2.0)))
        if not loop.fll:
            book = loop.threshold(STRESS_CYCLES)
            moved.append(threshold_of(f"{name} (rule {book:.1f})", f.around_stress, f.lost_stress,
                                      near(book, 2.0)))  # fmt: skip
    told = "3 sigma + stress = 45 deg (pilot 90 deg, FLL 1 / (4 T)): within 2 dB"
    return [
        Claim(
            "loop-threshold", "Tracking threshold, no motion: a tenth is lost in 10 s", KH, told,
            tuple(rule),
            "the rule knows neither the indicators that declare a loss, nor that noise takes the "
            "slope of an arctangent of 1 ms",
        ),
        Claim(
            "loop-threshold-own", "The larger of the rule's threshold and of the indicator's",
            "this project", "C/N0 at which noise takes the indicator to its limit: within 2 dB",
            tuple(ours),
            "low by 1.4 to 5.2 dB: jitter grows before the limit is reached, an arctangent of "
            "1 ms has lost its slope, and an FLL's own error adds to the noise of its indicator",
            target=True,
        ),
        Claim(
            "loop-threshold-stress", "Tracking threshold with 22.5 deg of stress by jerk or "
            "acceleration", KH, told, tuple(moved),
            "the rule takes the steady error; at the onset the error overshoots by up to 47 %",
        ),
    ]  # fmt: skip


def curve_claims(curves: tuple[dict[str, Curves], PhaseCurves]) -> list[Claim]:
    """S-curves."""
    code, phase = curves
    kinds = list(CODE_DISCRIMINATORS)
    unbiased = [kinds.index(k) for k in ("dot-product", "power")]
    off = {}
    for (name, c), s in zip(code.items(), (*CURVE_SPACINGS, *CURVE_SPACINGS), strict=False):
        near = np.abs(c.error_chips) <= s + 1e-9
        off[name] = float(np.abs(c.quiet - c.formula)[:, near].max() / s)
    shown = [(c.noisy - c.quiet)[unbiased] / c.sigma[unbiased] for c in code.values()]
    share = float(np.mean(np.abs(np.concatenate([x.ravel() for x in shown])) < 1.96))
    inside = np.abs(phase.noisy - phase.formula) < 1.96 * phase.sigma + 1e-3
    return [
        Claim(
            "loop-s-curves", "S-curves of the code discriminators, without noise",
            f"{KH}; triangle and BOC(1,1) by hand", "R of independent chips in each definition",
            tuple(number(n, x, Must("below", 0.1), "D/2 at most, errors up to D/2")
                  for n, x in off.items()),
            "what is left are the side lobes of C/A codes, 6 % of the peak; at D = 1 both "
            "flanks have them",
        ),
        Claim(
            "loop-s-noise", "In noise, 30 dB-Hz and 10 ms, dot product and power keep their curve",
            BK, "A is known: unbiased",
            (number("share of means within 1.96 standard errors", share,
                    Must("within", (0.9, 0.99))),),
            "envelope and coherent ones lose slope: see the figure",
        ),
        Claim(
            "loop-s-phase", "S-curves of the phase discriminators in noise, 30 dB-Hz and 10 ms",
            "Middleton 1960: density of the angle", "saw-tooth with its harmonics reduced",
            tuple(number(k, float(inside[i].mean()), Must("above", 0.85),
                         "of the means within 1.96 standard errors")
                  for i, k in enumerate(PHASE_DISCRIMINATORS)),
            "this is the slope that PLLs lose near threshold",
        ),
    ]  # fmt: skip


def cn0_claims(cn0: dict[str, np.ndarray]) -> list[Claim]:
    """Biases of one second, and the other authors' numbers."""
    at = {level: k for k, level in enumerate(LEVELS)}

    def bias(kind: str, level: float, must: Must | None) -> Quantity:
        values = cn0[kind][at[level]]
        return interval(f"{kind}, {level:g} dB-Hz", values[np.isfinite(values)],
                        lambda x: x.mean(axis=-1), "dB", must)  # fmt: skip

    def about(value: float, half: float) -> Must:
        return Must("within", (round(value - half, 2), round(value + half, 2)))

    none = float(np.isnan(cn0["m2m4 1 ms"][at[20.0]]).mean())
    return [
        Claim(
            "loop-cn0", "Biases of the C/N0 estimators, one second of perfect lock",
            "independent Monte Carlo",
            "NWPR -0.25, -0.11, 0 dB at 20, 30, 45 dB-Hz; SNV, M2M4 of 20 ms +0.3, +0.5 at 20",
            (bias("nwpr", 20.0, about(-0.25, 0.15)), bias("nwpr", 30.0, about(-0.11, 0.1)),
             bias("nwpr", 45.0, about(0.0, 0.1)), bias("snv 20 ms", 20.0, about(0.3, 0.2)),
             bias("m2m4 20 ms", 20.0, about(0.5, 0.4))),
            "the mean of a ratio, |I| of noise, and a root of few samples",
        ),
        Claim(
            "loop-cn0-m2m4", "M2M4 of 1 ms prompts breaks below 27 dB-Hz",
            "independent Monte Carlo", "+4.6 dB at 20 dB-Hz, none in 43 % of the seconds",
            (bias("m2m4 1 ms", 20.0, about(4.6, 0.6)),
             number("without an answer", none, Must("within", (0.35, 0.51))),
             bias("m2m4 1 ms", 30.0, None)),
            "2 M2^2 - M4 is a small difference of large numbers; the mean is of those with "
            "an answer",
        ),
    ]  # fmt: skip
