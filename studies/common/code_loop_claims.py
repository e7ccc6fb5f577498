"""What the study `loop_theory` claims of code loops that nothing aids."""

from __future__ import annotations

import numpy as np

from common.code_loops import CODE_LOOPS, LEVELS, CodeFlown, CodeLoop
from common.ledger import Claim, Must
from common.loop_cells import CLEAR_DB
from common.loop_claims import BK, FIVE, KH, ratio, threshold_of
from common.statistics import interval


def clear(loop: CodeLoop) -> list[int]:
    """Levels where linear theory is held to its word."""
    return [k for k, x in enumerate(LEVELS) if x >= loop.threshold() + CLEAR_DB]


def code_loop_claims(flown: dict[str, CodeFlown]) -> list[Claim]:
    """Jitter, stress, threshold."""
    jitter = [ratio(name, flown[name].code[:, clear(loop)], FIVE)
              for name, loop in CODE_LOOPS.items()]  # fmt: skip
    stress = [interval(name, f.stress, lambda x: x.mean(axis=-1), "", FIVE)
              for name, f in flown.items()]  # fmt: skip
    thresholds = []
    for name, loop in CODE_LOOPS.items():
        rule, f = loop.threshold(), flown[name]
        must = Must("within", (float(np.round(rule - 2.0, 2)), float(np.round(rule + 2.0, 2))))
        thresholds.append(threshold_of(f"{name} (rule {rule:.1f})", f.around, f.lost, must))
    return [
        Claim(
            "loop-dll-alone",
            f"Thermal jitter of a DLL without aid, C/N0 from {CLEAR_DB:g} dB above the threshold "
            "up to 50 dB-Hz",
            f"{BK}; {KH}",
            "D / (2 C/N0) Bn and the squaring loss of each discriminator: ratio 1",
            tuple(jitter),
            "Bn is that of the digital loop",
        ),
        Claim(
            "loop-dll-stress",
            "Dynamic stress of a DLL without aid: rate / w, acceleration / w^2",
            KH,
            "ratio 1",
            tuple(stress),
            "w of the digital loop; 0.01 chip, where the discriminators are straight",
        ),
        Claim(
            "loop-dll-threshold",
            "Tracking threshold of a DLL without aid: a tenth is a chip off within 10 s",
            KH,
            "3 sigma = D / 2: within 2 dB",
            tuple(thresholds),
            "the rule is careful: beyond D / 2 the output no longer grows, but it still points "
            "back, up to a chip away; the envelope's noise is bounded by that of envelopes",
        ),
    ]
