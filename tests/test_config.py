"""Configuration: what is refused, and with which words."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import yaml

from mastd3r.config import Config, SourceConfig, config_from_dict, config_from_yaml, config_to_yaml, with_override
from mastd3r.errors import ConfigError


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
        ({"correction": ["fine"]}, "expected one of none, coarse, fine, coarse-to-fine, got ['fine']"),
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
