"""Suites: those that ship, what a user's file may say, entries and their order; and the numbers of others."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from mastd3r.config import Config, with_override
from mastd3r.errors import ConfigError, InputError
from mastd3r.experiments.published import FILE, published_table, sources
from mastd3r.experiments.suite import entries_of, load_suite, sequences_of, shipped_suites, suite_from_dict
from mastd3r.export.metric_names import NAMES

TINY: dict[str, Any] = {
    "title": "Tiny",
    "sequences": {"a": {}, "b": {"dataset": "bonn", "folder": "rgbd_b", "set": {"source.stride": 2}}},
    "settings": {"mapping.enabled": False},
    "variants": {"one": {"set": {"correction": "none"}}, "two": None},
    "seeds": [0, 2],
    "tables": [{"title": "t", "form": "variants", "metrics": ["ate_rmse_all"]}],
}


def changed(**changes: Any) -> dict[str, Any]:
    return {**TINY, **changes}


@pytest.mark.parametrize("name", shipped_suites())
def test_shipped_suites_are_sound(name: str) -> None:
    suite = load_suite(name)
    assert suite.name == name and len(suite.seeds) == 3
    for table in suite.tables:
        rows = published_table(table.published).rows
        if table.form == "variants":
            assert {r.name for r in rows} <= {v.name for v in suite.variants}
            assert all(set(r.values) <= set(table.metrics) for r in rows)
        else:
            assert suite.sequences is not None
            assert all(set(r.values) <= {s.name for s in suite.sequences} for r in rows)
            assert {r.metric for r in rows} <= set(table.metrics)
    assert load_suite(name) == suite


def test_the_papers_tables_all_ship() -> None:
    assert set(shipped_suites()) == {"tum-dynamic", "bonn", "kitti", "correction", "loss", "local"}
    named = {t.published for n in shipped_suites() for t in load_suite(n).tables} - {""}
    assert named == set(yaml.safe_load(FILE.read_text())["tables"])


def test_what_others_printed_adds_up() -> None:
    """A printed mean is that of its own columns, so that a slip of our pen shows; two rows of the source are off."""
    checked, odd = 0, []
    for name in ("tum-dynamic", "bonn", "kitti"):
        for row in published_table(name).rows:
            assert row.metric in NAMES and row.source in sources()
            if row.average is None:
                assert all(0 < v < 1 for v in row.values.values())  # metres, not centimetres
                continue
            checked += 1
            slack = 1.01 * 10.0 ** -len(str(row.average).partition(".")[2])
            if abs(np.mean(list(row.values.values())) - row.average) > slack:
                odd.append((name, row.name))
    assert checked == 36 and odd == [("bonn", "DROID-Splat"), ("bonn", "MASt3R-SLAM")]
    assert published_table("").rows == ()
    with pytest.raises(ConfigError, match="expected one of tum-dynamic"):
        published_table("replica")


def test_entries_come_first_seed_first_with_every_option() -> None:
    suite = suite_from_dict(TINY, "tiny")
    assert suite.sequences is not None
    entries = entries_of(suite, suite.sequences)
    labels = ["a/one", "b/one", "a/two", "b/two"]
    assert [e.label for e in entries] == [f"{x}/{seed}" for seed in (0, 2) for x in labels]
    config = entries[5].config  # b/one/2
    assert (config.seed, config.source.start, config.source.stride) == (2, 2, 2)
    assert (config.correction, config.mapping.enabled) == ("none", False)
    again = Config()
    for item in entries[5].overrides:
        again = with_override(again, item)
    assert again == config  # the command by hand is the same run
    assert len({e.id for e in entries}) == len(entries)


def test_a_changed_option_is_another_entry() -> None:
    before = {e.id for e in entries_of(suite_from_dict(TINY, "t"), [])} | _ids(TINY)
    assert _ids(TINY) == before
    assert not _ids(changed(settings={"mapping.enabled": False, "tracking.cell_px": 9})) & before
    other = changed(variants={"one": {"set": {"correction": "fine"}}, "two": None})
    assert len(_ids(other) & before) == len(before) // 2
    assert _ids(changed(title="other words", seeds=[2, 0])) == before


def _ids(data: dict[str, Any]) -> set[str]:
    suite = suite_from_dict(data, "t")
    return {e.id for e in entries_of(suite, suite.sequences or ())}


def test_only_chooses_by_pattern() -> None:
    suite = suite_from_dict(TINY, "tiny")
    chosen = entries_of(suite, suite.sequences or (), only="b/*/0")
    assert [e.label for e in chosen] == ["b/one/0", "b/two/0"]
    assert {e.seed for e in entries_of(suite, suite.sequences or (), seeds=[7])} == {7}
    with pytest.raises(ConfigError, match="--only: expected a pattern"):
        entries_of(suite, suite.sequences or (), only="c/*")
    for seeds in ([], [1, 1], [-1]):
        with pytest.raises(ConfigError, match="--seeds: expected different whole numbers"):
            entries_of(suite, suite.sequences or (), seeds=seeds)


BAD: list[tuple[Any, str]] = [
    (None, "expected key: value pairs, got None"),
    ([], "expected key: value pairs"),
    ({"title": "x"}, "expected sequences, tables, variants, got only title"),
    (changed(sequence="x"), "unknown key sequence; perhaps you meant sequences"),
    (changed(seeds=[0.5]), "seeds: expected different whole numbers"),
    (changed(seeds=[True]), "seeds: expected different whole numbers"),
    (changed(memory_mib="much"), "memory_mib: expected a number above 0, got 'much'"),
    (changed(settings={"mapping.iteration": 5}), "settings: config: unknown key mapping.iteration; perhaps"),
    (changed(variants={}), "variants: expected at least one"),
    (changed(variants={"x": {"sett": {}}}), "variants.x: unknown key sett; perhaps you meant set"),
    (changed(variants={"x": {"set": {"correction": "best"}}}), "variants.x.set: config correction: expected one of"),
    (changed(sequences={}), "sequences: expected 'any', or at least one"),
    (changed(sequences=["a"]), "sequences: expected key: value pairs"),
    (changed(sequences={"a": {"path": "x"}}), "sequences.a: unknown key path"),
    (changed(tables=[]), "tables: expected a list of tables"),
    (changed(tables=[{"title": "t"}]), r"tables\[0\]: expected form, metrics"),
    (
        changed(tables=[{"title": "t", "form": "pie", "metrics": ["frames"]}]),
        "form: expected one of sequences",
    ),
    (changed(tables=[{"title": "t", "form": "variants", "metrics": ["ate"]}]), "metrics: unknown ate"),
    (
        changed(tables=[{"title": "t", "form": "variants", "metrics": ["frames"], "published": "ours"}]),
        "published: expected one of tum-dynamic",
    ),
    (
        changed(tables=[{"title": "t", "form": "variants", "metrics": ["frames"], "variants": ["tow"]}]),
        "variants: unknown tow; perhaps you meant two",
    ),
]


@pytest.mark.parametrize(("data", "says"), BAD, ids=range(len(BAD)))
def test_a_file_that_does_not_fit_is_named(data: Any, says: str) -> None:
    with pytest.raises(ConfigError, match=says) as caught:
        suite_from_dict(data, "mine")
    assert "suite mine" in str(caught.value) and "\n" not in str(caught.value)


def test_where_sequences_are_looked_for(tmp_path: Path) -> None:
    suite = suite_from_dict(TINY, "tiny")
    a, b = suite.sequences or ()
    assert a.find(tmp_path) is None and b.how_to_get() == "mastd3r download bonn b --to DATA" and a.how_to_get() == ""
    (tmp_path / "a").mkdir()
    (tmp_path / "bonn" / "rgbd_b").mkdir(parents=True)
    assert a.find(tmp_path) == tmp_path / "a" and b.find(tmp_path) == tmp_path / "bonn" / "rgbd_b"
    (tmp_path / "rgbd_b").mkdir()
    assert b.find(tmp_path) == tmp_path / "rgbd_b"
    assert [s.name for s in sequences_of(suite, tmp_path, ["b"])] == ["b"]
    with pytest.raises(ConfigError, match="--sequences: expected some of a, b, got 'c'"):
        sequences_of(suite, tmp_path, ["c"])
    with pytest.raises(InputError, match="expected the folder that holds the sequences"):
        sequences_of(suite, tmp_path / "none")


def test_any_means_folders_with_truth(tmp_path: Path) -> None:
    suite = suite_from_dict(changed(sequences="any"), "tiny")
    with pytest.raises(InputError, match=r"expected folders with rgb\.txt and groundtruth\.txt, got none"):
        sequences_of(suite, tmp_path)
    for name, files in {"x": ("rgb.txt", "groundtruth.txt"), "y": ("rgb.txt",), "z": ()}.items():
        (tmp_path / name).mkdir()
        for file in files:
            (tmp_path / name / file).touch()
    assert [s.name for s in sequences_of(suite, tmp_path)] == ["x"]
    assert [s.name for s in sequences_of(suite, tmp_path, ["y", "gone"])] == ["y", "gone"]  # said to be missing later
