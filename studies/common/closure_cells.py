"""Closures, motions and C/N0 of the study `closures`: what is flown with what.

Every closure flies the same sky, the eleven satellites above 5 deg of the presets', the same
motion, IMU (grade tactical) and oscillator (TCXO), and with the same seed the same noise of each
and, on samples, the same samples.
"""

from __future__ import annotations

from typing import Any

from common.campaign import Campaign

Change = dict[str, Any]

FIVE = (2, 4, 12, 19, 28)
"""All round, and one overhead"""
BLOCKED = {2: (17, 22), 4: (17, 22, 9, 14), 6: (17, 22, 9, 14, 3, 6)}
"""What is blocked; of eleven satellites the five of `FIVE` are never"""
DURATION_S, SETTLED_S = 20.0, 5.0
BLOCKED_S, JUMP_S = (6.0, 14.0), (8.0, 13.0)
G10 = 98.0
DEEP_DB = -45.0
FIRST_SEED = 3001
RUNS, BLOCKED_RUNS, ERROR_RUNS, OUTAGE_RUNS, SAMPLE_RUNS = 8, 6, 6, 4, 3


def _fll(hz: float, order: int) -> Change:
    """With the discriminator of the vector loops at low C/N0."""
    return {
        "receiver.closure": "scalar", "receiver.carrier_loop": "fll",
        "receiver.fll_bandwidth_hz": hz, "receiver.fll_order": order,
        "receiver.frequency_discriminator": "cross",
    }  # fmt: skip


def _tight(closure: str, measurement: str, name: str = "qkf", **more: Any) -> Change:
    return {
        "receiver.closure": closure, "receiver.measurement": measurement, "receiver.filter": name,
        **more,
    }  # fmt: skip


def _vector(states: int) -> Change:
    return {"receiver.closure": "vdfll", "receiver.vector.states": states}


CLOSURES: dict[str, Change] = {
    "scalar": {"receiver.closure": "scalar"},
    "scalar, 50 Hz": {
        "receiver.closure": "scalar", "receiver.bandwidth_hz": 50.0,
        "receiver.integration_s": 0.002,
    },
    "scalar FLL": _fll(4.7, 2),
    "scalar-ins": {"receiver.closure": "scalar-ins"},
    "VDFLL": _vector(11),
    "VDFLL-8": _vector(8),
    "federated 40 ms": _tight("federated", "differential"),
    "federated 100 ms": _tight(
        "federated", "differential", **{"receiver.federated.update_s": 0.1}
    ),
    "ultra-tight D": _tight("ultra-tight", "differential"),
    "ultra-tight C": _tight("ultra-tight", "coherent"),
    "D, FIQKF-R": _tight("ultra-tight", "differential", "fiqkf-r"),
    "C, FIQKF-R": _tight("ultra-tight", "coherent", "fiqkf-r"),
}  # fmt: skip
"""D: differential measurement, unknown data bits, as the federated ones; C: coherent, known bits"""
INS = ("federated 40 ms", "federated 100 ms", "ultra-tight D", "ultra-tight C")
FADING = ("D, FIQKF-R", "C, FIQKF-R")
MAIN = ("scalar", "scalar-ins", "VDFLL", *INS)
COST = dict.fromkeys((*INS, *FADING), 0.5)
"""Of a run of 20 s, in units of an ultra-tight one of 50 s; of the others 5"""

WORLD: Change = {
    "mask_deg": 5.0, "duration_s": DURATION_S, "jump_window_s": [SETTLED_S, DURATION_S],
    "imu.grade": "tactical", "imu.accel_scale_factor_ppm": None, "imu.lag_s": None,
    "receiver.fall_back": True,
}  # fmt: skip
_JUMP: Change = {
    "profile": [
        {"t0_s": JUMP_S[0], "t1_s": JUMP_S[1], "accel0_mps2": G10, "accel1_mps2": G10}
    ]
}  # fmt: skip


def disturbed(t0_s: float, t1_s: float, prns: tuple[int, ...] | None = None) -> Change:
    """Satellites, all by default, that are not heard for a while."""
    which = {} if prns is None else {"prns": list(prns)}
    step = {"t0_s": t0_s, "t1_s": t1_s, "cn0_change_db": DEEP_DB}
    return {"channel.disturbance": [step | which]}


MOTIONS: dict[str, Change] = {
    "uniform": {},
    "5 satellites": {"prns": list(FIVE)},
    "jump": _JUMP,
    "jump, 3000 ppm": _JUMP | {"imu.accel_scale_factor_ppm": [3000.0, 0.0, 0.0]},
    **{f"{n} blocked": disturbed(*BLOCKED_S, prns) for n, prns in BLOCKED.items()},
}

_LOOPS, _INS = (25.0, 26.0, 27.0, 28.0), (8.0, 11.0, 14.0, 17.0, 20.0, 22.0, 24.0, 26.0)
_INS_BLOCKED = (11.0, 17.0, 20.0, 22.0, 24.0)
LEVELS: dict[str, dict[str, tuple[float, ...]]] = {
    "uniform": {
        "scalar": _LOOPS, "scalar-ins": _LOOPS, "scalar FLL": (23.0, 24.0, 25.0, 26.0),
        "VDFLL": (15.5, 16.5, 17.5, 18.5, 20.0, 22.0), "VDFLL-8": (14.5, 15.5, 16.5, 17.5),
        **dict.fromkeys(INS, _INS),
    },
    "5 satellites": {
        "VDFLL": (17.0, 18.0, 19.0, 20.5, 22.0),
        **dict.fromkeys(INS, _INS),
    },
    "jump": {
        "scalar": (28.0, 34.0, 42.0), "scalar, 50 Hz": (28.0, 30.0, 32.0, 34.0),
        "scalar-ins": _LOOPS, "scalar FLL": (28.0, 34.0, 42.0),
        "VDFLL": (22.0, 24.0, 26.0, 28.0),
        **dict.fromkeys((*INS, *FADING), _INS),
    },
    "jump, 3000 ppm": {"scalar-ins": _LOOPS, **dict.fromkeys((*INS, *FADING), _INS)},
    "2 blocked": {
        "VDFLL": (16.5, 17.5, 18.5),
        **dict.fromkeys(INS, _INS_BLOCKED),
    },
    "4 blocked": {
        "VDFLL": (16.5, 17.5, 18.5, 19.5),
        **dict.fromkeys(INS, _INS_BLOCKED),
    },
    "6 blocked": {
        "scalar": _LOOPS[1:], "scalar-ins": _LOOPS[1:], "VDFLL": (17.0, 18.0, 19.0, 20.5),
        **dict.fromkeys(INS, _INS_BLOCKED),
    },
}  # fmt: skip
"""Dense around each threshold, after a coarse look with other seeds (9001, 9002); scalar channels
know nothing of each other: five of the eleven are not flown apart"""
ERROR_LEVELS = (25.0, 30.0, 35.0, 45.0)
OUTAGES_S, OUTAGE_LEVELS, BEFORE_S, AFTER_S = (1.0, 3.0, 10.0, 30.0), (30.0, 40.0), 5.0, 15.0
SAMPLE_LEVEL, SAMPLE_S = 35.0, 8.0
QUICK = ("scalar", "VDFLL", "ultra-tight D")
QUICK_MOTIONS = ("uniform",)


def levels(values: tuple[float, ...]) -> dict[str, Change]:
    """An axis of C/N0."""
    return {f"{x:g}": {"cn0_dbhz": x} for x in values}


def outage(seconds: float) -> Change:
    """No satellite at all for so long."""
    end_s = BEFORE_S + seconds
    return disturbed(BEFORE_S, end_s) | {
        "duration_s": end_s + AFTER_S, "jump_window_s": [BEFORE_S, end_s]
    }  # fmt: skip


def _cost(name: str, duration_s: float = DURATION_S) -> float:
    return COST.get(name, 5.0) * duration_s / DURATION_S


def campaigns(quick: bool) -> dict[str, Campaign]:
    """All of them; a quick look leaves most closures, motions and levels out."""
    names = [n for n in CLOSURES if not quick or n in QUICK]
    made = {}
    for motion, rows in LEVELS.items():
        if quick and motion not in QUICK_MOTIONS:
            continue
        runs = BLOCKED_RUNS if "blocked" in motion else RUNS
        for name in (n for n in rows if n in names):
            over = {"receiver": {name: WORLD | CLOSURES[name] | MOTIONS[motion]},
                    "cn0_dbhz": levels(rows[name][:: 3 if quick else 1])}  # fmt: skip
            made[f"{motion}; {name}"] = Campaign("uniform", over, runs, FIRST_SEED, _cost(name))
    main = [n for n in MAIN if n in names]
    made |= {f"errors; {n}": _errors(n, quick) for n in main}
    made |= {f"outage; {n}": _outages(n, quick) for n in main}
    alone = {"alone": WORLD | CLOSURES["federated 40 ms"] | {"cn0_dbhz": 0.0}}
    made["INS alone"] = Campaign("uniform", {"receiver": alone}, RUNS, FIRST_SEED, COST[INS[0]])
    made["samples"] = _samples(main)
    return made


def _errors(name: str, quick: bool) -> Campaign:
    over = {
        "receiver": {name: WORLD | CLOSURES[name]},
        "cn0_dbhz": levels(ERROR_LEVELS[2:3] if quick else ERROR_LEVELS),
    }
    return Campaign("uniform", over, ERROR_RUNS, FIRST_SEED, _cost(name))


def _outages(name: str, quick: bool) -> Campaign:
    lengths = {f"{s:g}": outage(s) for s in OUTAGES_S[: 1 if quick else None]}
    same = {k: v for k, v in WORLD.items() if k not in outage(1.0)}
    over = {
        "receiver": {name: same | CLOSURES[name]},
        "outage": lengths,
        "cn0_dbhz": levels(OUTAGE_LEVELS[1:] if quick else OUTAGE_LEVELS),
    }
    duration_s = BEFORE_S + sum(OUTAGES_S) / len(OUTAGES_S) + AFTER_S
    return Campaign("uniform", over, OUTAGE_RUNS, FIRST_SEED, _cost(name, duration_s))


def _samples(names: list[str]) -> Campaign:
    short = {"duration_s": SAMPLE_S, "jump_window_s": [3.0, SAMPLE_S], "cn0_dbhz": SAMPLE_LEVEL}
    over = {
        "receiver": {n: WORLD | CLOSURES[n] | short for n in names},
        "correlator": {kind: {"correlator.kind": kind} for kind in ("model", "samples")},
    }
    return Campaign("uniform", over, SAMPLE_RUNS, FIRST_SEED, 6.0)
