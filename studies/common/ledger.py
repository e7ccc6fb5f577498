"""The claim ledger: what was claimed, what came out here, and the verdict that follows from both.

A row holds measured quantities, each with a condition; the verdict is computed from them and is
nowhere typed.  Rows are merged by their id, so that studies may run one by one.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

REPRODUCED, CHANGED, NOT = "reproduced", "reproduced with a stated change", "not reproduced"
MET, MISSED = "met", "not met"
BEGIN, END = "<!-- ledger: generated, do not edit -->", "<!-- end of ledger -->"

Kind = Literal["above", "below", "within", "covers"]


@dataclass(frozen=True)
class Must:
    """What a quantity has to fulfil for its claim to stand.

    above, below: the value, or the end of its interval that ``on`` names, is at least (at most)
    ``bound``; within: it lies between the two bounds; covers: the interval holds the bound.
    """

    kind: Kind
    bound: float | tuple[float, float]
    on: Literal["value", "low", "high"] = "value"


@dataclass(frozen=True)
class Quantity:
    """A measured number with its 95 % interval; a number that is missing fulfils nothing."""

    name: str
    value: float | None
    low: float | None
    high: float | None
    unit: str
    must: Must | None = None


@dataclass(frozen=True)
class Claim:
    """One row.  ``change`` says what had to be altered for the claim to stand; ``target`` marks an
    aim of this project, which is met or not, in place of somebody's claim.  The last four are the
    study's to fill in; ``code`` is the beginning of the SHA-256 of the sources that were flown."""

    id: str
    claim: str
    source: str
    theirs: str
    ours: tuple[Quantity, ...]
    why: str
    change: str = ""
    target: bool = False
    study: str = ""
    command: str = ""
    quick: bool = False
    code: str = ""

    def row(self) -> dict[str, Any]:
        """As it stands in the file, with the verdict."""
        row = json.loads(json.dumps(asdict(self)))
        return row | {"verdict": verdict(row)}


def holds(quantity: Mapping[str, Any]) -> bool:
    """Whether a quantity of a row fulfils its condition; without one it always does."""
    must = quantity["must"]
    if must is None:
        return True
    ends = [quantity["low"], quantity["high"]]
    value, bound = quantity[must["on"]], must["bound"]
    if must["kind"] == "covers":
        return None not in ends and ends[0] <= bound <= ends[1]
    if value is None:
        return False
    if must["kind"] == "within":
        return bool(bound[0] <= value <= bound[1])
    return bool(value >= bound if must["kind"] == "above" else value <= bound)


def verdict(row: Mapping[str, Any]) -> str:
    """The verdict that follows from the numbers, the conditions and the stated change."""
    if not any(quantity["must"] for quantity in row["ours"]):
        raise ValueError(f"claim {row['id']}: no quantity has a condition, expected one at least")
    stands = all(holds(quantity) for quantity in row["ours"])
    if row["target"]:
        return MET if stands else MISSED
    if not stands:
        return NOT
    return CHANGED if row["change"] else REPRODUCED


# -- files ----------------------------------------------------------------------------------------


def read(path: Path) -> list[dict[str, Any]]:
    """The rows of a ledger, none if there is no file yet."""
    return json.loads(path.read_text()) if path.is_file() else []


def merge(path: Path, claims: Iterable[Claim], study: str) -> list[dict[str, Any]]:
    """Put a study's rows in the place of those it wrote before; the file is replaced as a whole.

    The order is that of the studies' names, and within a study as it gives them.
    """
    given = [claim.row() for claim in claims]
    others = [row for row in read(path) if row["study"] != study]
    rows = sorted([*others, *given], key=lambda row: row["study"])
    write(path, json.dumps(rows, indent=1, ensure_ascii=False) + "\n")
    return rows


def write(path: Path, text: str) -> None:
    """A text file, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    part.write_text(text)
    part.replace(path)


def refresh(readme: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Put the table of the rows between the marks in a Markdown file."""
    text = readme.read_text()
    before, mark, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (mark and end):
        raise ValueError(f"{readme}: no marks found, expected {BEGIN} and {END}")
    write(readme, f"{before}{BEGIN}\n{markdown(rows)}{END}{after}")


# -- words ----------------------------------------------------------------------------------------

_SIGNS = {"above": "≥", "below": "≤", "within": "in", "covers": "covers"}


def number(value: float | None) -> str:
    """Three significant digits, without a power of ten where that can be."""
    if value is None:
        return "-"
    if value == 0 or 1e-3 <= abs(value) < 1e4:
        digits = f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
        return digits.replace("-", "−")
    return f"{value:.1e}".replace("-", "−")


def words(quantity: Mapping[str, Any]) -> str:
    """Name, value, interval, unit and condition of a quantity on one line."""
    unit = f" {quantity['unit']}" if quantity["unit"] else ""
    text = f"{quantity['name']}: **{number(quantity['value'])}**"
    if quantity["low"] is not None:
        text += f" [{number(quantity['low'])}, {number(quantity['high'])}]"
    must = quantity["must"]
    if must is None:
        return text + unit
    bound = must["bound"]
    bounds = " to ".join(map(number, bound)) if isinstance(bound, list) else number(bound)
    end = {"low": "lower end ", "high": "upper end ", "value": ""}[must["on"]]
    return f"{text}{unit} (expected: {end}{_SIGNS[must['kind']]} {bounds})"


def markdown(rows: Sequence[Mapping[str, Any]]) -> str:
    """One table per study; commands stand above it."""
    lines: list[str] = []
    for study in dict.fromkeys(row["study"] for row in rows):
        mine = [row for row in rows if row["study"] == study]
        lines += ["", f"### {study}", "", f"`{mine[0]['command']}`", ""]
        lines += ["| claim | source | theirs | ours | verdict | why |", "|---|---|---|---|---|---|"]
        for row in mine:
            ours = "<br>".join(words(quantity) for quantity in row["ours"])
            change = f"<br>change: {row['change']}" if row["change"] else ""
            quick = "<br>(few seeds: `--quick`)" if row["quick"] else ""
            cells = (
                row["claim"], row["source"], row["theirs"], ours + quick,
                f"**{row['verdict']}**{change}", row["why"],
            )  # fmt: skip
            lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join([*lines, "", ""])
