"""Descriptions of IF files: SigMF by its own library, our side-car, and foreign files."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sigmf

from signals.constants import GPS_L1_HZ
from signals.sample_formats import FORMATS, encode
from signals.sigmf_files import Description, metadata, open_recording, paths, write_description

FS, IF = 4.0e6, 1.0e6


def write(folder: Path, name: str, n: int = 4000) -> tuple[np.ndarray, Path]:
    """A described file of random samples in a format; the samples and the path without ending."""
    form, rng = FORMATS[name], np.random.default_rng(1)
    shape = (n,) if form.real else (n, 2)
    levels = [-1, 1] if form.packing and form.packing.bits == 1 else [-3, -1, 1, 3]
    x = rng.choice(np.array(levels), shape).astype(form.value_dtype)
    stored = encode(x, form).tobytes()
    data, meta = paths(folder / "flight.1", name)
    data.write_bytes(stored)
    sha = hashlib.sha512(stored).hexdigest()
    write_description(
        meta,
        Description(
            name, FS, IF, n, 1.5, 2149, 475_220.0, "a test", "pytest", sha, (39.9, 116.4, 50.0)
        ),
    )
    return x, folder / "flight.1"


@pytest.mark.parametrize("name", [f.name for f in FORMATS.values() if f.sigmf])
def test_the_sigmf_library_reads_what_is_written(tmp_path: Path, name: str) -> None:
    """Valid by its schema, the right checksum, datatype, and the same samples."""
    x, base = write(tmp_path, name)
    unsigned = name.endswith("u8")  # what is zero enters only where it scales, to 1
    read = sigmf.sigmffile.fromfile(str(base) + ".sigmf-meta", autoscale=unsigned)
    read.validate()
    assert read.get_global_field("core:datatype") == FORMATS[name].sigmf
    assert read.get_global_field("core:sha512") == read.calculate_hash()
    assert read.get_global_field("core:sample_rate") == FS
    capture = read.get_captures()[0]
    assert capture["core:frequency"] == GPS_L1_HZ - IF
    assert capture["core:datetime"] == "2021-03-19T12:00:02.000000Z"
    assert capture["core:geolocation"]["coordinates"] == [116.4, 39.9, 50.0]  # GeoJSON: lon first
    given = read.read_samples() * (128 if unsigned else 1)
    expected = x if x.ndim == 1 else x[:, 0] + 1j * x[:, 1]
    np.testing.assert_array_equal(np.asarray(given).reshape(expected.shape), expected)


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("end", ["", "data", "description"])
def test_a_described_file_opens_by_any_of_its_names(tmp_path: Path, name: str, end: str) -> None:
    x, base = write(tmp_path, name, 4001)
    data, meta = paths(base, name)
    recording = open_recording({"": base, "data": data, "description": meta}[end])
    assert (recording.sample_rate_hz, recording.if_hz, recording.sigma) == (FS, IF, 1.5)
    assert recording.format.name == name
    assert len(recording) == 4001
    given = recording.samples(3000, 4001)
    np.testing.assert_array_equal(given[:, 0] if x.ndim == 1 else given, x[3000:])


def test_what_is_given_goes_before_what_is_described(tmp_path: Path) -> None:
    _, base = write(tmp_path, "ci8")
    recording = open_recording(base, sample_rate_hz=5e6, if_hz=-1e5, sigma=2.0, sample_format="ri8")
    assert (recording.sample_rate_hz, recording.if_hz, recording.sigma) == (5e6, -1e5, 2.0)
    assert len(recording) == 8000


def test_a_raw_file_needs_everything_named(tmp_path: Path) -> None:
    path = tmp_path / "raw.bin"
    path.write_bytes(bytes(range(16)))
    with pytest.raises(ValueError, match=r"raw.bin: no SigMF metadata .* its format, IF$"):
        open_recording(path, sample_rate_hz=FS)
    recording = open_recording(path, sample_rate_hz=FS, if_hz=0.0, sample_format="ci16")
    assert len(recording) == 4
    with pytest.raises(ValueError, match=r"none.bin: no such file"):
        open_recording(tmp_path / "none.bin", sample_rate_hz=FS, if_hz=0.0, sample_format="ci16")


def foreign(**changes: Any) -> dict[str, Any]:
    """SigMF metadata as others write it: no namespace of ours, centre 1 MHz below L1."""
    tree: dict[str, Any] = {
        "global": {"core:datatype": "ci8", "core:version": "1.0.0", "core:sample_rate": FS},
        "captures": [{"core:sample_start": 0, "core:frequency": 1_574_420_000.0}],
        "annotations": [],
    }
    for key, value in changes.items():
        part = tree["captures"][0] if key in ("frequency", "header_bytes") else tree["global"]
        part[f"core:{key}"] = value
        if value is None:
            del part[f"core:{key}"]
    return tree


def opened(folder: Path, text: str) -> Any:
    (folder / "sky.sigmf-data").write_bytes(bytes(range(64)))
    (folder / "sky.sigmf-meta").write_text(text)
    return open_recording(folder / "sky.sigmf-meta")


def test_a_foreign_recording_has_its_if_from_its_centre(tmp_path: Path) -> None:
    recording = opened(tmp_path, json.dumps(foreign()))
    assert recording.if_hz == 1e6
    assert len(recording) == 32
    assert recording.sigma == pytest.approx(np.std(np.arange(0.0, 64.0, 2.0)))  # measured
    assert opened(tmp_path, json.dumps(foreign(offset=5))).first_sample == 5
    assert opened(tmp_path, json.dumps(foreign(datatype="ri8_le"))).format.name == "ri8"
    unsigned = opened(tmp_path, json.dumps(foreign(datatype="cu8")))
    assert unsigned.samples(0, 2).tolist() == [[-128, -127], [-126, -125]]
    big = opened(tmp_path, json.dumps(foreign(datatype="ci16_be")))
    assert big.samples(0, 2).tolist() == [[0x0001, 0x0203], [0x0405, 0x0607]]


BAD = {
    "not JSON": ("{\n", "line 2, byte 2: Expecting property name"),
    "no rate": (json.dumps(foreign(sample_rate=None)), "no usable 'core:sample_rate'"),
    "a list": ("[]", "expected SigMF metadata with core:sample_rate"),
    "64 bits": (json.dumps(foreign(datatype="cf64_le")), 'core:datatype "cf64_le", expected one o'),
    "a rate in words": (
        json.dumps(foreign(sample_rate="4e6")),
        "core:sample_rate is '4e6', expect",
    ),
    "a centre in words": (
        json.dumps(foreign(frequency="L1")),
        "core:frequency is 'L1', expected a",
    ),
    "before the start": (json.dumps(foreign(offset=-5)), "core:offset is -5, expected a whole num"),
    "half a sample": (json.dumps(foreign(offset=0.5)), "core:offset is 0.5, expected a whole num"),
    "elsewhere": (json.dumps(foreign(dataset="../x")), "core:dataset is '../x', expected the name"),
    "two streams": (json.dumps(foreign(num_channels=2)), "core:num_channels is not 1"),
    "headers": (json.dumps(foreign(header_bytes=16)), "core:header_bytes given"),
    "no centre": (json.dumps(foreign(frequency=None)), "no core:frequency"),
    "another band": (json.dumps(foreign(frequency=1.2276e9)), "expected a band that holds 1575420"),
}


@pytest.mark.parametrize("kind", BAD)
def test_metadata_that_cannot_be_used_is_named(tmp_path: Path, kind: str) -> None:
    text, expected = BAD[kind]
    with pytest.raises(ValueError, match=expected) as caught:
        opened(tmp_path, text)
    assert "sky.sigmf-meta" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_samples_that_do_not_fit_their_description(tmp_path: Path) -> None:
    _, base = write(tmp_path, "ci16")
    data = paths(base, "ci16")[0]
    whole = data.read_bytes()
    data.write_bytes(whole[:-3])
    with pytest.raises(ValueError, match=r"15997 bytes, expected 16000 .* truncated at byte 15997"):
        open_recording(base)
    data.unlink()
    with pytest.raises(ValueError, match=r"flight.1.sigmf-data: no such file"):
        open_recording(base)


def test_a_wrong_description_is_not_written(tmp_path: Path) -> None:
    path = tmp_path / "x.sigmf-meta"
    with pytest.raises(ValueError, match="SigMF metadata: -4"):
        write_description(path, Description("ci8", -4e6, 0.0, 1, 1.0, 2149, 0.0))
    assert list(tmp_path.iterdir()) == []


def test_packed_samples_say_how_they_are_packed() -> None:
    side = metadata(Description("ci2p", FS, IF, 10, 1.9, 2149, 0.0))
    assert side["mark"] == "ultratight-if-1"
    assert "first value in the lowest bits" in side["layout"]
    assert side["captures"][0]["core:frequency"] == GPS_L1_HZ - IF


@pytest.mark.parametrize(
    ("key", "value"),
    [("captures", 5), ("captures", ["a"]), ("core:frequency", [1]), ("core:offset", None)],
)
def test_metadata_of_the_wrong_shape_are_one_line(tmp_path: Path, key: str, value: object) -> None:
    np.zeros((100, 2), np.int8).tofile(tmp_path / "x.sigmf-data")
    meta = {
        "global": {"core:datatype": "ci8", "core:version": "1.2.0", "core:sample_rate": 4e6},
        "captures": [{"core:sample_start": 0, "core:frequency": 1575.42e6}],
        "annotations": [],
    }
    if key == "core:offset":
        meta["global"][key] = value
    elif key == "captures":
        meta[key] = value
    else:
        meta["captures"][0][key] = value
    (tmp_path / "x.sigmf-meta").write_text(json.dumps(meta))
    with pytest.raises(ValueError, match="x") as error:
        open_recording(tmp_path / "x")
    assert "\n" not in str(error.value)


def test_a_rate_that_no_receiver_has_is_refused_with_the_name_of_the_file(tmp_path: Path) -> None:
    for rate in (1e300, float("nan"), 1e-300):
        with pytest.raises(
            ValueError, match=r"sky.sigmf-data: sample_rate_hz is .* 1 to 1e\+12 Hz"
        ):
            opened(tmp_path, json.dumps(foreign(sample_rate=rate, frequency=GPS_L1_HZ)))


def test_a_folder_is_no_recording(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="a folder, expected a SigMF recording"):
        open_recording(tmp_path)
    with pytest.raises(ValueError, match=r"\.: a folder"):
        open_recording(".")
