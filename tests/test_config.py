"""Configuration: what is refused, and with which words."""

from __future__ import annotations

import dataclasses
import inspect
import logging
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

import mastd3r.config
from mastd3r.config import (
    PRESETS,
    RENAMED,
    Config,
    SourceConfig,
    check_config,
    config_from_dict,
    config_from_yaml,
    config_to_yaml,
    preset,
    ranges,
    with_override,
)
from mastd3r.errors import ConfigError
from mastd3r.registry import (
    ALIGNMENT,
    DYNAMICS,
    FEATURES,
    LARGEST,
    MAP_BACKENDS,
    PLACES,
    POINTMAPS,
    SEMANTICS,
    Range,
    Registry,
)


def test_defaults_survive_a_round_trip(tmp_path: Path) -> None:
    file = tmp_path / "c.yaml"
    file.write_text(config_to_yaml(Config()))
    assert config_from_yaml(file) == Config()


def test_changed_values_survive_a_round_trip(tmp_path: Path) -> None:
    config = with_override(Config(), "camera.intrinsics=[300, 301.5, 160, 120]")
    config = with_override(config, "source.end=12")
    config = with_override(config, "mapping.loss=plain")
    config = with_override(config, "mapping.paper_loss=true")
    config = with_override(config, "seed=7")
    file = tmp_path / "c.yaml"
    file.write_text(config_to_yaml(config))
    read = config_from_yaml(file)
    assert read == config
    assert read.camera.intrinsics == (300.0, 301.5, 160.0, 120.0) and read.source.end == 12
    assert yaml.safe_load(config_to_yaml(config))["camera"]["intrinsics"] == [300.0, 301.5, 160.0, 120.0]


def test_an_empty_file_is_the_defaults(tmp_path: Path) -> None:
    file = tmp_path / "c.yaml"
    file.write_text("# nothing\n")
    assert config_from_yaml(file) == Config() == config_from_dict({})


def test_overrides_leave_the_rest_alone() -> None:
    config = config_from_dict({"mapping": {"iterations": 5}, "source": {"stride": 2}})
    assert config.source == SourceConfig(stride=2)
    assert config.mapping == dataclasses.replace(Config().mapping, iterations=5)
    assert with_override(config, "source.end=null").source.end is None
    assert with_override(config, "tracking.min_inlier_ratio=1").tracking.min_inlier_ratio == 1.0


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ({"mappin": {}}, "unknown key mappin; perhaps you meant mapping"),
        ({"mapping": {"iteration": 3}}, "unknown key mapping.iteration; perhaps you meant mapping.iterations"),
        ({"graph": {"xyzzy": 3}}, "unknown key graph.xyzzy; known: bootstrap_keyframes"),
        ({3: 4}, "unknown key 3"),
        ({"seed": "many"}, "config seed: expected int, got 'many'"),
        ({"seed": True}, "config seed: expected int, got True"),
        ({"seed": 1.5}, "config seed: expected int, got 1.5"),
        ({"seed": None}, "config seed: expected int, got None"),
        ({"mapping": {"lambda_uncertainty": "0,1"}}, "mapping.lambda_uncertainty: expected float, got '0,1'"),
        ({"mapping": {"lambda_uncertainty": False}}, "mapping.lambda_uncertainty: expected float, got False"),
        ({"mapping": {"enabled": 1}}, "config mapping.enabled: expected bool, got 1"),
        ({"mapping": {"loss": "l2"}}, "expected one of plain, mask, uncertainty, full, got 'l2'"),
        (
            {"correction": ["fine"]},
            "config correction: expected one of none, coarse, fine, coarse-to-fine, got ['fine']",
        ),
        (
            {"pointmaps": "mast3"},
            "config pointmaps: expected one of auto, geometric, mast3r, depth, got 'mast3'; perhaps",
        ),
        ({"dynamics": {"variant": 3}}, "config dynamics.variant: expected one of ours, paper, none, got 3"),
        (
            {"dynamics": {"motion": {"flow_nois": 1}}},
            "key dynamics.motion.flow_nois; perhaps you meant dynamics.motion.f",
        ),
        ({"dynamics": {"motion": True}}, "config dynamics.motion: expected key: value pairs, got True"),
        ({"dynamics": {"motion": {"enabled": 1}}}, "config dynamics.motion.enabled: expected bool, got 1"),
        ({"dynamics": {"use_hea": True}}, "unknown key dynamics.use_hea; known: variant"),
        ({"dynamics": {"use_head": 3}}, "config dynamics.appearance.enabled: expected bool, got 3"),
        (
            {"dynamics": {"appearance": 3, "use_head": True}},
            "config dynamics.appearance: expected key: value pairs, got 3",
        ),
        (
            {"dynamics": {"use_head": True, "appearance": {"enabled": True}}},
            "config: expected dynamics.appearance.enabled or its old name dynamics.use_head, got both",
        ),
        ({"source": {"end": "last"}}, "config source.end: expected int, got 'last'"),
        ({"camera": {"intrinsics": 300}}, "config camera.intrinsics: expected a list, got 300"),
        ({"camera": {"intrinsics": ["f"]}}, "config camera.intrinsics: expected float, got 'f'"),
        ({"source": 3}, "config source: expected key: value pairs, got 3"),
        ({"source": None}, "config source: expected key: value pairs, got None"),
    ],
)
def test_what_is_refused(data: dict[Any, Any], words: str) -> None:
    with pytest.raises(ConfigError) as e:
        config_from_dict(data)
    assert words in str(e.value) and "\n" not in str(e.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("source.stride", "expected section.key=value, got 'source.stride'"),
        ("source.strid=2", "perhaps you meant source.stride"),
        ("source.stride=[", "--set source.stride"),
        ("stride=2", "unknown key stride"),
        ("=2", "unknown key"),
        ("seed.x=2", "config seed: expected int, got {'x': 2}"),
        ("dynamics.temporal.memry=1", "perhaps you meant dynamics.temporal.memory"),
    ],
)
def test_overrides_that_are_refused(text: str, words: str) -> None:
    with pytest.raises(ConfigError) as e:
        with_override(Config(), text)
    assert words in str(e.value) and "\n" not in str(e.value)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"a: [1, 2", "expected readable YAML"),
        (b"- 1\n- 2\n", "expected key: value pairs, got list"),
        (b"just words", "expected key: value pairs, got str"),
        (b"\xff\xfe\x00\x01", "expected readable YAML"),
        (None, "expected readable YAML"),
    ],
)
def test_files_that_are_refused(tmp_path: Path, content: bytes | None, words: str) -> None:
    file = tmp_path / "c.yaml"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(ConfigError) as e:
        config_from_yaml(file)
    assert words in str(e.value) and str(file) in str(e.value)
    assert "\n" not in str(e.value)


def leaf(config: Any, dotted: str) -> Any:
    """The value of a dotted key."""
    for name in dotted.split("."):
        config = getattr(config, name)
    return config


# -- sections in sections, names of before ----------------------------------------------------------------------------


def test_sections_of_sections_are_read_from_yaml_and_from_words(tmp_path: Path) -> None:
    file = tmp_path / "c.yaml"
    file.write_text("dynamics:\n  temporal:\n    smoother_gaps: [1, 5]\n  motion: {enabled: false}\n")
    config = with_override(config_from_yaml(file), "dynamics.appearance.share=1")
    d = config.dynamics
    assert (d.temporal.smoother_gaps, d.motion.enabled, d.appearance.share) == ((1, 5), False, 1.0)
    assert d.temporal.filter_gaps == Config().dynamics.temporal.filter_gaps
    assert config_from_dict(yaml.safe_load(config_to_yaml(config))) == config


def half(value: Any) -> Any:
    return value // 2 if isinstance(value, int) else value / 2


@pytest.mark.parametrize("old", sorted(RENAMED))
def test_an_old_name_sets_the_new_option_and_says_so(
    old: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    new, before = RENAMED[old], leaf(Config(), RENAMED[old])
    value: Any = [2, 3] if isinstance(before, tuple) else not before if isinstance(before, bool) else half(before)
    section, key = old.split(".")
    file = tmp_path / "c.yaml"
    file.write_text(yaml.safe_dump({section: {key: value}}))
    caplog.set_level(logging.WARNING, logger="mastd3r.config")  # a command that was quiet may have gone before
    mastd3r.config._say_renamed.cache_clear()
    read = config_from_yaml(file)
    assert read == with_override(Config(), f"{old}={value}") == with_override(Config(), f"{new}={value}")
    assert leaf(read, new) == (tuple(value) if isinstance(value, list) else value) and read != Config()
    assert caplog.messages == [f"config: {old} is now {new}; the old name goes with the next version"]


def test_old_and_new_names_stand_beside_each_other() -> None:
    config = config_from_dict(
        {"dynamics": {"use_head": False, "appearance": {"share": 0.7}, "head_limit": 2, "base_rate": 0.2}}
    )
    a = config.dynamics.appearance
    assert (a.enabled, a.share, a.max_log_odds, config.dynamics.base_rate) == (False, 0.7, 2.0, 0.2)


# -- parts by name, presets -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("registry", "key"),
    [
        (POINTMAPS, "pointmaps"),
        (FEATURES, "features"),
        (SEMANTICS, "semantics"),
        (PLACES, "places"),
        (ALIGNMENT, "correction"),
        (DYNAMICS, "dynamics.variant"),
        (MAP_BACKENDS, "mapping.backend"),
    ],
)
def test_a_part_from_outside_can_be_chosen_while_it_is_there(registry: Registry, key: str) -> None:
    assert registry.option == key and leaf(Config(), key) in registry.choices
    with registry.registered("mine", lambda *_: None):
        assert leaf(with_override(Config(), f"{key}=mine"), key) == "mine"
    with pytest.raises(ConfigError, match=f"^config {key}: expected one of "):
        with_override(Config(), f"{key}=mine")


def test_the_paper_preset_takes_everything_as_printed() -> None:
    assert list(PRESETS) == ["fast", "quality", "paper"]
    paper, expected = preset("paper"), Config()
    for item in (
        "dynamics.variant=paper",
        "alignment.as_printed=true",
        "mapping.paper_loss=true",
        "mapping.hard_weight=true",
    ):
        expected = with_override(expected, item)
    assert paper == expected
    for key in options_as_printed():
        assert leaf(paper, key) != leaf(Config(), key), key
    with pytest.raises(ConfigError, match="preset: expected one of fast, quality, paper, got 'papr'"):
        preset("papr")


def options_as_printed() -> list[str]:
    """Dotted keys of the options of sections whose comment says "as printed"."""
    found = []
    for section in dataclasses.fields(Config):
        value = getattr(Config(), section.name)
        if dataclasses.is_dataclass(value):
            source = inspect.getsource(type(value))
            names = [f.name for f in dataclasses.fields(value)]
            found += [
                f"{section.name}.{n}" for n in names if re.search(rf"^    {n}: [^#]*#[^#]*as printed", source, re.M)
            ]
    return found


def test_the_options_as_printed_are_found_by_their_comments() -> None:
    assert options_as_printed() == [
        "alignment.as_printed",
        "dynamics.variant",
        "mapping.hard_weight",
        "mapping.paper_loss",
    ]


# -- ranges of numbers -----------------------------------------------------------------------------------------------


def numbers(section: Any = None, where: str = "") -> dict[str, Any]:
    """The default of every number among the options, by dotted key; of a list its first."""
    section = section or Config()
    out: dict[str, Any] = {}
    for f in dataclasses.fields(section):
        value, hint = getattr(section, f.name), str(f.type)
        if dataclasses.is_dataclass(value):
            out |= numbers(value, f"{where}{f.name}.")
        elif f.name != "intrinsics" and not isinstance(value, bool | str) and "bool" not in hint:
            out[where + f.name] = value
    return out


def with_value(key: str, value: Any) -> Config:
    """Built as a library's user does, around every check."""
    *sections, last = key.split(".")
    parts: list[Any] = [Config()]
    for name in sections:
        parts.append(getattr(parts[-1], name))
    made = dataclasses.replace(parts.pop(), **{last: value})
    for name in reversed(sections):
        made = dataclasses.replace(parts.pop(), **{name: made})
    return made


def test_every_number_has_a_range() -> None:
    assert set(numbers()) == set(ranges()) and len(ranges()) > 70
    assert check_config(Config()) == Config()


@pytest.mark.parametrize("key", numbers())
def test_what_is_out_of_range_is_refused_however_it_comes(key: str) -> None:
    default = numbers()[key]
    listed = isinstance(default, tuple)
    for value in (-1, float("nan"), float("inf"), -float("inf"), 10**400, True, "x"):
        given = (value,) if listed else value
        with pytest.raises(ConfigError, match=re.escape(key)) as by_library:
            check_config(with_value(key, given))
        nested: Any = list(given) if isinstance(given, tuple) else given
        for part in reversed(key.split(".")):
            nested = {part: nested}
        with pytest.raises(ConfigError, match=re.escape(key)):
            config_from_dict(nested)
        assert "expected" in str(by_library.value) and len(str(by_library.value)) < 300


def test_a_range_says_what_it_is() -> None:
    assert str(Range(0, 1)) == "0 to 1" and str(Range(0, 1, above=True)) == "above 0, to 1"
    assert str(Range(1, LARGEST)) == "1 or more"
    assert str(Range(0, LARGEST, above=True)) == "above 0"
    Range(0, 1).check(0, "x")
    with pytest.raises(ConfigError, match="x: expected above 0, to 1, got 0"):
        Range(0, 1, above=True).check(0, "x")


@pytest.mark.parametrize("text", ["seed=2020-01-01", 'seed=!!int "x"', "seed=" + "[" * 5000, "seed=" + "9" * 5000])
def test_odd_yaml_is_one_short_line(text: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as by_word:
        with_override(Config(), text)
    (tmp_path / "c.yaml").write_text(text.replace("=", ": "))
    with pytest.raises(ConfigError) as by_file:
        config_from_yaml(tmp_path / "c.yaml")
    for said in (by_word, by_file):
        assert "\n" not in str(said.value) and len(str(said.value)) < 400
