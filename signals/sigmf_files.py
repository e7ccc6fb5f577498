"""IF samples with their description: SigMF pairs, and a side-car for what SigMF has no name for.

A SigMF recording is NAME.sigmf-data and NAME.sigmf-meta (sigmf.org, version 1.2).  The nominal
carrier stands at ``if_hz`` of the file, hence ``core:frequency``, the radio frequency of the file's
0 Hz, is the carrier minus ``if_hz``.  What SigMF does not know is kept in the namespace
"ultratight".  Packed samples are NAME.bin, described by NAME.json with the same keys.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from signals.constants import GPS_L1_HZ
from signals.gps_time import utc_text
from signals.recording import Recording
from signals.sample_formats import FORMATS, file_format

SIDE_CAR = "ultratight-if-1"
"""Mark of our description of packed samples"""
_OWN = "ultratight:"
_SIGNS = (
    "samples are I + jQ; a carrier above core:frequency turns counter-clockwise; positive Doppler "
    "(approaching) raises the carrier; GPS L1 stands at if_hz"
)


@dataclass(frozen=True)
class Description:
    """What one must know to use a file of samples; ``more`` goes into the file as it is."""

    format: str
    sample_rate_hz: float
    if_hz: float
    n_samples: int
    sigma: float
    start_week: int
    start_tow_s: float
    text: str = ""
    recorder: str = ""
    sha512: str = ""
    position_lla_deg_m: tuple[float, float, float] | None = None
    annotations: tuple[dict[str, Any], ...] = ()
    more: dict[str, Any] = field(default_factory=dict)


def paths(name: Path, form: str) -> tuple[Path, Path]:
    """Paths of samples and description of a file called ``name`` in a format."""
    ends = (".bin", ".json") if file_format(form).packed else (".sigmf-data", ".sigmf-meta")
    return name.with_name(name.name + ends[0]), name.with_name(name.name + ends[1])


def metadata(d: Description) -> dict[str, Any]:
    """SigMF metadata, or a side-car with the same keys, as nested plain data.

    Raises
    ------
    ValueError : the SigMF library finds the metadata wrong.
    """
    form = file_format(d.format)
    own = {
        "if_hz": d.if_hz,
        "sigma": d.sigma,
        "n_samples": d.n_samples,
        "start_week": d.start_week,
        "start_tow_s": d.start_tow_s,
        "signs": _SIGNS,
        **d.more,
    }
    capture: dict[str, Any] = {
        "core:sample_start": 0,
        "core:frequency": GPS_L1_HZ - d.if_hz,
        "core:datetime": utc_text(d.start_week, d.start_tow_s),
    }
    if d.position_lla_deg_m:
        lat, lon, h = d.position_lla_deg_m
        capture["core:geolocation"] = {"type": "Point", "coordinates": [lon, lat, h]}
    head: dict[str, Any] = {
        "core:sample_rate": d.sample_rate_hz,
        "core:description": d.text,
        "core:recorder": d.recorder,
        "core:hw": "none: simulated",
        "core:sha512": d.sha512,
    }
    head = {key: value for key, value in head.items() if value != ""}
    head |= {_OWN + key: value for key, value in own.items()}
    if form.packing is not None:
        layout = form.packing.text + ("" if form.real else ", I before Q")
        side = {"mark": SIDE_CAR, "format": form.name, "layout": layout}
        return side | {"global": head, "captures": [capture], "annotations": [*d.annotations]}
    return _validated(
        {
            "global": {"core:datatype": form.sigmf, **head}
            | {"core:extensions": [{"name": "ultratight", "version": "1.0.0", "optional": True}]},
            "captures": [capture],
            "annotations": [*d.annotations],
        }
    )


def _validated(tree: dict[str, Any]) -> dict[str, Any]:
    import sigmf  # here: only those who write files wait for it
    from sigmf.validate import validate

    tree["global"]["core:version"] = sigmf.__specification__
    try:
        validate(tree)
    except Exception as error:  # jsonschema's own hierarchy
        line = str(error).splitlines()[0]
        raise ValueError(f"SigMF metadata: {line}") from None
    return tree


def write_description(path: Path, d: Description) -> None:
    """Write the description, whole or not at all."""
    part = path.with_name(f"{path.name}.partial")
    try:
        part.write_text(json.dumps(metadata(d), indent=2) + "\n", encoding="utf-8")
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def open_recording(
    path: str | Path,
    *,
    sample_format: str | None = None,
    sample_rate_hz: float | None = None,
    if_hz: float | None = None,
    sigma: float | None = None,
    swap_iq: bool = False,
    conjugate: bool = False,
) -> Recording:
    """A recording from NAME, NAME.sigmf-meta or -data, NAME.json or .bin, or from a raw file.

    What is given goes before what a description says; a raw file has none and needs format, rate
    and IF.

    Raises
    ------
    ValueError : a file that is missing, truncated or of another kind, or not described enough.
    """
    path = Path(path)
    if path.is_dir():
        raise ValueError(f"{path}: a folder, expected a SigMF recording or a file of raw samples")
    try:
        described = _description_of(path)
        data, said = (path, {}) if described is None else _facts(described)
        stands_at = if_hz
        if described is not None and if_hz is None:
            stands_at = _if_hz(described, said)
    except (TypeError, AttributeError, RecursionError, KeyError, IndexError) as error:
        raise ValueError(f"{path}: its metadata are not as SigMF has them ({error})") from None
    if described is None:
        missing = {
            "format": sample_format,
            "rate": sample_rate_hz,
            "IF": if_hz,
        }
        if not path.is_file():
            raise ValueError(f"{path}: no such file, expected a SigMF recording or raw samples")
        unknown = [name for name, value in missing.items() if value is None]
        if sample_format is None or sample_rate_hz is None or if_hz is None:
            raise ValueError(
                f"{path}: no SigMF metadata beside it, expected its {', '.join(unknown)}"
            )
        return Recording(
            path, sample_rate_hz, if_hz, sigma,
            sample_format=sample_format, swap_iq=swap_iq, conjugate=conjugate,
        )  # fmt: skip
    return Recording(
        data,
        said["sample_rate_hz"] if sample_rate_hz is None else sample_rate_hz,
        stands_at or 0.0,
        said["sigma"] if sigma is None else sigma,
        sample_format=sample_format or said["format"],
        first_sample=said["first_sample"],
        n_samples=None if sample_format else said["n_samples"],
        swap_iq=swap_iq,
        conjugate=conjugate,
    )


def own_facts(path: str | Path) -> dict[str, Any]:
    """What a description has in our namespace, without its prefix; none: an empty dictionary."""
    described = _description_of(Path(path))
    if described is None:
        return {}
    head = json.loads(described.read_text(encoding="utf-8"))["global"]
    return {k.removeprefix(_OWN): v for k, v in head.items() if k.startswith(_OWN)}


def _description_of(path: Path) -> Path | None:
    """The file that describes ``path``, if there is one."""
    partner = {".sigmf-data": ".sigmf-meta", ".bin": ".json"}
    if path.suffix in (".sigmf-meta", ".json"):
        if not path.is_file():
            raise ValueError(f"{path}: no such file, expected a description of samples")
        return path
    if path.suffix in partner:
        candidates = [path.with_suffix(partner[path.suffix])]
    else:
        candidates = [path.with_name(path.name + end) for end in partner.values()]
    return next((c for c in candidates if c.is_file()), None)


def _facts(path: Path) -> tuple[Path, dict[str, Any]]:
    """Path of the samples and what the description at ``path`` says of them."""
    try:
        tree = json.loads(path.read_text(encoding="utf-8"))
        head, captures = tree["global"], tree.get("captures") or [{}]
        rate = float(head["core:sample_rate"])
    except UnicodeDecodeError:
        raise ValueError(f"{path}: not a text file, expected SigMF metadata (JSON)") from None
    except json.JSONDecodeError as error:
        line = f"line {error.lineno}, byte {error.pos}"
        raise ValueError(f"{path}: {line}: {error.msg}, expected SigMF metadata (JSON)") from None
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(
            f"{path}: no usable {error}, expected SigMF metadata with core:sample_rate"
        ) from None
    if tree.get("mark") == SIDE_CAR:
        name, data = str(tree.get("format")), path.with_suffix(".bin").name
    else:
        name = _format_name(path, str(head.get("core:datatype")))
        data = head.get("core:dataset") or f"{path.stem}.sigmf-data"
    if head.get("core:num_channels", 1) != 1:
        raise ValueError(f"{path}: core:num_channels is not 1, expected one stream of samples")
    if any(c.get("core:header_bytes") for c in captures):
        raise ValueError(f"{path}: core:header_bytes given, expected samples from byte 0")
    if Path(data).name != data:
        raise ValueError(f"{path}: core:dataset is {data!r}, expected the name of a file beside it")
    n_samples, first = head.get(_OWN + "n_samples"), head.get("core:offset", 0)
    for key, value in ((_OWN + "n_samples", n_samples), ("core:offset", first)):
        if value is not None and not (type(value) is int and value >= 0):
            raise ValueError(f"{path}: {key} is {value!r}, expected a whole number, 0 or more")
    numbers = [(k, head.get(k)) for k in ("core:sample_rate", _OWN + "sigma", _OWN + "if_hz")]
    for key, value in (*numbers, *(("core:frequency", c.get("core:frequency")) for c in captures)):
        if value is not None and type(value) not in (int, float):
            raise ValueError(f"{path}: {key} is {value!r}, expected a number")
    centres = {c.get("core:frequency") for c in captures}
    if len(centres) > 1:
        raise ValueError(f"{path}: core:frequency changes on the way, expected one centre")
    return path.with_name(data), {
        "format": name,
        "sample_rate_hz": rate,
        "centre_hz": centres.pop(),
        "if_hz": head.get(_OWN + "if_hz"),
        "sigma": head.get(_OWN + "sigma"),
        "n_samples": n_samples,
        "first_sample": first or 0,
    }


def _format_name(path: Path, datatype: str) -> str:
    # one byte has no order; both spellings are in use
    known = {f.sigmf: f.name for f in FORMATS.values() if f.sigmf}
    name = known.get(datatype) or known.get(datatype.removesuffix("_le"))
    if name is None:
        types = ", ".join(known)
        raise ValueError(f'{path}: core:datatype "{datatype}", expected one of {types}')
    return name


def _if_hz(path: Path, said: dict[str, Any]) -> float:
    if said["if_hz"] is not None:
        return float(said["if_hz"])
    if said["centre_hz"] is None:
        raise ValueError(f"{path}: no core:frequency, expected it there, or the IF to be given")
    offset = GPS_L1_HZ - float(said["centre_hz"])
    if abs(offset) > said["sample_rate_hz"] / 2.0:
        raise ValueError(
            f"{path}: core:frequency {said['centre_hz']:.10g} Hz at {said['sample_rate_hz']:g} "
            f"samples/s, expected a band that holds {GPS_L1_HZ:.10g} Hz"
        )
    return offset
