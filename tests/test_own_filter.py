"""A user's own filter by name: FILE.py:NAME or package.module:NAME, in runs and in sweeps."""

from __future__ import annotations

import hashlib
import shutil
import sys
from pathlib import Path

import pytest

import ultratight
from ultratight.__main__ import main
from ultratight.filters.catalog import make_filter
from ultratight.provenance import provenance

SHORT = {"duration_s": 1.0, "prns": [2, 6, 17, 28]}
MINE = """
from ultratight.filters.gaussian import predict, update
from ultratight.filters.rules import get_rule

class Plain:
    def reset(self):
        pass

    def step(self, state, prediction, measurement):
        prior = predict(state, prediction.phi, prediction.q)
        return update(prior, measurement, get_rule("linearised"))

class Needs:
    def __init__(self, size):
        pass

class Half:
    def reset(self):
        pass

number = 3
"""
ROOT = Path(__file__).parents[1]
EXAMPLE = ROOT / "studies" / "examples" / "own_filter.py"


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    path = tmp_path / "mine.py"
    path.write_text(MINE)
    return path


def short(name: object) -> ultratight.Scenario:
    return ultratight.load("uniform", SHORT | {"receiver.filter": str(name)})


def test_an_own_filter_flies_like_the_catalogues_twin(mine: Path) -> None:
    """The same arithmetic from a file as from the row `kf`: the same bits."""
    own, theirs = ultratight.run(short(f"{mine}:Plain"), 1), ultratight.run(short("kf"), 1)
    assert own["v_eb_e"].tolist() == theirs["v_eb_e"].tolist()
    assert own.summary["filter"] == f"{mine}:Plain"


def test_a_module_serves_too(mine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (mine.parent / "given").mkdir()
    shutil.copy(mine, mine.parent / "given" / "inner.py")
    monkeypatch.syspath_prepend(str(mine.parent))
    scenario = short("given.inner:Plain")
    sha = hashlib.sha256(MINE.encode()).hexdigest()
    assert scenario.files_sha256() == {"receiver.filter": sha}
    assert ultratight.run(scenario, 1).provenance["filter_sha256"] == sha
    assert scenario.digest() == short(f"{mine}:Plain").digest()  # wherever it is
    sys.modules.pop("given.inner"), sys.modules.pop("given", None)


def test_its_source_is_in_digest_and_provenance(mine: Path) -> None:
    before, sha = short(f"{mine}:Plain").digest(), hashlib.sha256(mine.read_bytes()).hexdigest()
    assert provenance(short(f"{mine}:Plain"), 1)["filter_sha256"] == sha
    assert short(f"{mine}:Plain").digest() == before
    mine.write_text(MINE.replace("linearised", "gh3"))
    changed = short(f"{mine}:Plain")
    assert changed.digest() != before
    assert (
        ultratight.run(changed, 1)["v_eb_e"].tolist()
        == ultratight.run(short("qkf3"), 1)["v_eb_e"].tolist()
    )  # what flies is what the file says now


def test_a_scenario_file_finds_it_beside_itself(mine: Path) -> None:
    file = mine.parent / "mine.toml"
    file.write_text('extends = "uniform"\n[receiver]\nfilter = "mine.py:Plain"\n')
    assert ultratight.load(file).receiver.filter == f"{mine}:Plain"


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("none.py:Plain", "(there is no such file)"),
        ("no.such.module:Plain", "(there is no such module)"),
        ("{mine}:Plane", "expected a class or function in mine.py (no Plane)"),
        ("{mine}:number", "expected a class or function in mine.py (no number)"),
        ("{mine}:Needs", "cannot be made without arguments: TypeError"),
        ("{mine}:Half", "a Half has no step"),
        ("{bad}:Plain", "cannot be loaded: SyntaxError"),
        ("{mine}:", "expected FILE.py:NAME or package.module:NAME"),
        (":Plain", "expected FILE.py:NAME or package.module:NAME"),
        ("a b:c", "expected FILE.py:NAME or package.module:NAME"),
    ],
)
def test_what_is_no_filter_is_refused_in_one_line(
    mine: Path, name: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (mine.parent / "bad.py").write_text("def (:\n")
    name = name.format(mine=mine, bad=mine.parent / "bad.py")
    assert main(["validate", "uniform", "--filter", name]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith(f'error: receiver.filter: "{name}" given, expected')
    assert words in lines[0]


def test_in_a_sweep_by_name_and_by_factory(mine: Path, tmp_path: Path) -> None:
    over = {"receiver.filter": ["kf", f"{mine}:Plain", "twin"]}
    data = ultratight.sweep(
        short("kf"), over, runs=2, jobs=1, filters={"twin": lambda: make_filter("kf")}
    )
    assert data["filter"].values.tolist() == over["receiver.filter"]
    states = data.estimate_sha256.values
    assert states[0].tolist() == states[1].tolist() == states[2].tolist()


@pytest.mark.parametrize(
    ("filters", "words"),
    [
        ({"kf": make_filter}, "filters: kf given, expected a name that is not taken"),
        ({"mine": 3}, "filters: mine is 3, expected a class or function"),
        ({"mine": int}, "a int has no step"),
    ],
)
def test_factories_that_make_none_are_refused(filters: dict, words: str) -> None:
    with pytest.raises(ultratight.InvalidInput) as refused:
        ultratight.sweep(short("kf"), {"receiver.filter": ["kf"]}, filters=filters)
    assert words in str(refused.value)


def test_the_page(tmp_path: Path) -> None:
    """Its first block is a file that flies: cubature by another name; its last is the example."""
    blocks = (ROOT / "docs" / "own_filter.md").read_text(encoding="utf-8").split("```python\n")[1:]
    first, *_, last = (block.partition("```")[0] for block in blocks)
    (tmp_path / "mine.py").write_text(first)
    few = ultratight.run(short(f"{tmp_path}/mine.py:FewPoints"), 1)
    twin = ultratight.run(short("qkf"), 1, filter=make_filter("qkf", rule="cubature-projected"))
    assert few["v_eb_e"].tolist() == twin["v_eb_e"].tolist()
    assert last.strip() in EXAMPLE.read_text(encoding="utf-8")


def test_the_example(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """As it ships, but for two runs of a jump that is cut to its first seconds."""
    text = EXAMPLE.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 25
    file = tmp_path / "small.toml"
    file.write_text(
        'extends = "jump-1"\nduration_s = 5.0\njump_window_s = [3.0, 5.0]\n'
        "profile = [{t0_s = 3.0, t1_s = 5.0, accel0_mps2 = 100.0, accel1_mps2 = 100.0}]\n"
    )
    small = text.replace("runs=20", "runs=2, jobs=1").replace('"jump-1"', repr(str(file)))
    assert small.count("runs=2,") == 1
    assert small.count("small.toml") == 1
    script = tmp_path / "own_filter.py"
    script.write_text(small)
    exec(compile(small, str(script), "exec"), {"__name__": "example"})
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in lines] == ["mine - qkf", "mine - fiqkf-r"]
    assert all(line.endswith("m/s, median of 2 pairs") for line in lines)
    assert float(lines[0].split(":")[1].split()[0]) < 0.0  # it holds a jump that breaks QKF
