"""A suite: sequences, variants, seeds and tables, read from a small YAML file; and the entries that it means.

title: what it is
sequences: any | {name: {dataset: tum, folder: NAME, set: {key: value}}}
settings: {section.key: value}             # of every entry
variants: {name: {title: words, set: {section.key: value}, memory_mib: number}}
seeds: [0, 1, 2]
tables: [{title: words, form: sequences | variants, variants: [name], metrics: [key], published: NAME}]
"""

from __future__ import annotations

import difflib
import fnmatch
import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from ..config import Config, config_to_yaml, with_override
from ..errors import ConfigError, InputError
from ..export.metric_names import NAMES
from ..reading.files import entries_of as entries_in
from ..reading.files import is_dir, is_file, short, user_path
from ..reading.yaml_text import yaml_file, yaml_value
from ..registry import LARGEST
from .published import published_table

SHIPPED = Path(__file__).parents[1] / "suites"
MEMORY_MIB = 1500.0  # of an entry where neither a finished one nor the suite tells
TableForm = Literal["sequences", "variants"]
FORMS: dict[str, TableForm] = {"sequences": "sequences", "variants": "variants"}


@dataclass(frozen=True)
class SequenceSpec:
    """One sequence: where it may lie under the data folder, and how to get it."""

    name: str
    dataset: str = ""  # as ``mastd3r download`` names it; empty: nothing to download
    folder: str = ""  # under the data folder, or under the dataset's folder there; empty: the name
    download: str = ""  # its name for ``mastd3r download``; empty: the name
    overrides: tuple[str, ...] = ()

    def find(self, data: Path) -> Path | None:
        """Its folder, or None where it is missing."""
        wanted = self.folder or self.name
        places = [data / wanted, data / self.dataset / wanted, data / self.name, data / self.dataset / self.name]
        return next((place for place in places if os.path.isdir(place)), None)

    def how_to_get(self) -> str:
        """The command that brings it; nothing where none does."""
        return f"mastd3r download {self.dataset} {self.download or self.name} --to DATA" if self.dataset else ""


@dataclass(frozen=True)
class Variant:
    """One way to run: options that differ from the suite's."""

    name: str
    title: str
    overrides: tuple[str, ...]
    memory_mib: float


@dataclass(frozen=True)
class TableSpec:
    """One table: methods over sequences (Tables I-III) or figures of variants (Tables IV and V)."""

    title: str
    form: TableForm
    variants: tuple[str, ...]
    metrics: tuple[str, ...]
    published: str = ""  # name of a table in published.yaml


@dataclass(frozen=True)
class Suite:
    """What is run, and what is made of it. ``sequences`` None: every TUM-layout folder with truth."""

    name: str
    title: str
    sequences: tuple[SequenceSpec, ...] | None
    settings: tuple[str, ...]
    variants: tuple[Variant, ...]
    seeds: tuple[int, ...]
    tables: tuple[TableSpec, ...]
    raw: dict[str, Any]  # the file's own content, kept with the results


@dataclass(frozen=True)
class Entry:
    """One run of a suite. Another effective configuration is another entry."""

    sequence: SequenceSpec
    variant: Variant
    seed: int
    config: Config
    overrides: tuple[str, ...]  # what makes ``config`` of the defaults, as --set takes them

    @property
    def label(self) -> str:
        """sequence/variant/seed, which --only is matched with."""
        return f"{self.sequence.name}/{self.variant.name}/{self.seed}"

    @property
    def id(self) -> str:
        """File name: what it is in words, and eight digits that stand for the configuration."""
        what = [self.sequence.dataset, self.sequence.folder, self.label, config_to_yaml(self.config)]
        digest = hashlib.sha256(json.dumps(what).encode()).hexdigest()[:8]
        return f"{_plain(self.sequence.name)}--{_plain(self.variant.name)}--seed{self.seed}--{digest}"


def shipped_suites() -> list[str]:
    """Names of the suites that come with the package."""
    return sorted(p.stem for p in SHIPPED.glob("*.yaml"))


def load_suite(name: str) -> Suite:
    """A shipped suite by its name, or a file of the user's. Raises ConfigError."""
    path = SHIPPED / f"{name}.yaml"
    if name not in shipped_suites():
        path = user_path(name, "suite", ConfigError)
        if not is_file(path):
            near = difflib.get_close_matches(name, shipped_suites(), n=1)
            hint = f"; perhaps you meant {near[0]}" if near else ""
            known = ", ".join(shipped_suites())
            raise ConfigError(f"suite: expected one of {known}, or a YAML file, got {name!r}{hint}")
    return suite_from_dict(yaml_file(path, "suite", ConfigError), path.stem)


def suite_from_dict(data: Any, name: str) -> Suite:
    """A suite of a YAML file's content. Raises ConfigError for whatever does not fit."""
    where = f"suite {name}"
    known = {"title", "sequences", "settings", "variants", "seeds", "tables", "memory_mib"}
    data = _mapping(data, where, known, needed={"title", "sequences", "variants", "tables"})
    settings = _overrides(data.get("settings", {}), f"{where}: settings")
    memory_mib = _number(data.get("memory_mib", MEMORY_MIB), f"{where}: memory_mib")
    variants = tuple(
        _variant(key, value, memory_mib, f"{where}: variants.{key}")
        for key, value in _mapping(data["variants"], f"{where}: variants").items()
    )
    if not variants:
        raise ConfigError(f"{where}: variants: expected at least one, got none")
    sequences = _sequences(data["sequences"], f"{where}: sequences")
    suite = Suite(
        name=name,
        title=str(data["title"]),
        sequences=sequences,
        settings=settings,
        variants=variants,
        seeds=checked_seeds(data.get("seeds", [0]), f"{where}: seeds"),
        tables=_tables(data["tables"], [v.name for v in variants], f"{where}: tables"),
        raw=data,
    )
    for variant in variants:
        for sequence in sequences or (SequenceSpec("any"),):
            _entry(suite, sequence, variant, 0)  # refuses unknown options before anything runs
    return suite


def sequences_of(suite: Suite, data: Path, names: Sequence[str] | None = None) -> tuple[SequenceSpec, ...]:
    """The suite's sequences, or those of ``names`` in their order. Raises InputError, ConfigError."""
    if not is_dir(data):
        raise InputError(f"--data {data}: expected the folder that holds the sequences, got no such folder")
    if suite.sequences is not None:
        known = {s.name: s for s in suite.sequences}
        wrong = [n for n in names or () if n not in known]
        if wrong:
            raise ConfigError(f"--sequences: expected some of {', '.join(known)}, got {wrong[0]!r}")
        return tuple(known[n] for n in names) if names else suite.sequences
    if names:
        return tuple(SequenceSpec(n) for n in names)
    found = [p.name for p in entries_in(data) if is_file(p / "rgb.txt") and is_file(p / "groundtruth.txt")]
    if not found:
        raise InputError(f"--data {data}: expected folders with rgb.txt and groundtruth.txt, got none")
    return tuple(SequenceSpec(n) for n in found)


def entries_of(
    suite: Suite, sequences: Sequence[SequenceSpec], seeds: Sequence[int] | None = None, only: str | None = None
) -> list[Entry]:
    """Every entry in the order of running: all variants of the first seed first. Raises ConfigError."""
    found = [
        _entry(suite, sequence, variant, seed)
        for seed in (suite.seeds if seeds is None else checked_seeds(seeds, "--seeds"))
        for variant in suite.variants
        for sequence in sequences
    ]
    if only is None:
        return found
    chosen = [e for e in found if fnmatch.fnmatchcase(e.label, only)]
    if not chosen:
        raise ConfigError(f"--only: expected a pattern of sequence/variant/seed such as {found[0].label}, got {only!r}")
    return chosen


def checked_seeds(seeds: Any, where: str) -> tuple[int, ...]:
    """Whole numbers from 0 on, each once. Raises ConfigError."""
    fits = isinstance(seeds, list | tuple) and seeds and all(type(s) is int and s >= 0 for s in seeds)
    if not fits or len(set(seeds)) != len(seeds):
        raise ConfigError(f"{where}: expected different whole numbers from 0 on, got {seeds!r}")
    return tuple(seeds)


def _entry(suite: Suite, sequence: SequenceSpec, variant: Variant, seed: int) -> Entry:
    """Seed n also starts n frames later: one seed is one result, so what the run sees has to vary."""
    given = (*suite.settings, *sequence.overrides, *variant.overrides)
    config = Config()
    for item in given:
        config = with_override(config, item)
    start = config.source.start + seed
    config = replace(config, seed=seed, source=replace(config.source, start=start))
    mine = (f"seed={seed}", f"source.start={start}") if seed else ()
    return Entry(sequence, variant, seed, config, (*given, *mine))


def _plain(name: str) -> str:
    return "".join(c if c.isalnum() or c in "_-." else "_" for c in name)


def _mapping(data: Any, where: str, known: set[str] | None = None, needed: set[str] | None = None) -> dict[str, Any]:
    if not isinstance(data, Mapping):
        raise ConfigError(f"{where}: expected key: value pairs, got {short(repr(data))}")
    for key in data:
        if not isinstance(key, str) or (known is not None and key not in known):
            near = difflib.get_close_matches(str(key), known or (), n=1)
            hint = f"; perhaps you meant {near[0]}" if near else f"; known: {', '.join(sorted(known or ()))}"
            raise ConfigError(f"{where}: unknown key {short(str(key))}{hint}")
    lacking = sorted((needed or set()) - set(data))
    if lacking:
        raise ConfigError(f"{where}: expected {', '.join(lacking)}, got only {', '.join(data) or 'nothing'}")
    return dict(data)


def _overrides(data: Any, where: str) -> tuple[str, ...]:
    """{section.key: value} as --set takes it; checked against the options there are."""
    items = tuple(f"{key}={_as_set(value)}" for key, value in _mapping(data, where).items())
    for item in items:
        try:
            with_override(Config(), item)
        except ConfigError as e:
            raise ConfigError(f"{where}: {e}") from e
    return items


def _as_set(value: Any) -> str:
    plain = isinstance(value, str) and _reads_as_itself(value)
    return str(value) if plain else json.dumps(value)


def _reads_as_itself(text: str) -> bool:
    try:
        return bool(yaml_value(text, "", ConfigError) == text)
    except ConfigError:
        return False


def _number(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value <= LARGEST:
        raise ConfigError(f"{where}: expected a number above 0, got {short(repr(value))}")
    return float(value)


def _variant(name: str, data: Any, memory_mib: float, where: str) -> Variant:
    data = _mapping(data if data is not None else {}, where, {"title", "set", "memory_mib"})
    memory_mib = _number(data.get("memory_mib", memory_mib), f"{where}.memory_mib")
    return Variant(name, str(data.get("title", name)), _overrides(data.get("set", {}), f"{where}.set"), memory_mib)


def _sequences(data: Any, where: str) -> tuple[SequenceSpec, ...] | None:
    if data == "any":
        return None
    found = []
    for name, given in _mapping(data, where).items():
        at = f"{where}.{name}"
        value = _mapping(given if given is not None else {}, at, {"dataset", "folder", "download", "set"})
        overrides = _overrides(value.get("set", {}), f"{at}.set")
        dataset, folder, download = (str(value.get(key, "")) for key in ("dataset", "folder", "download"))
        found.append(SequenceSpec(name, dataset, folder, download, overrides))
    if not found:
        raise ConfigError(f"{where}: expected 'any', or at least one sequence, got none")
    return tuple(found)


def _tables(data: Any, variants: list[str], where: str) -> tuple[TableSpec, ...]:
    if not isinstance(data, list) or not data:
        raise ConfigError(f"{where}: expected a list of tables, got {short(repr(data))}")
    found = []
    for number, given in enumerate(data):
        at = f"{where}[{number}]"
        value = _mapping(given, at, {"title", "form", "variants", "metrics", "published"}, {"title", "form", "metrics"})
        form = FORMS.get(value["form"]) if isinstance(value["form"], str) else None
        if form is None:
            raise ConfigError(f"{at}.form: expected one of {', '.join(FORMS)}, got {value['form']!r}")
        chosen = _names(value.get("variants", variants), variants, f"{at}.variants")
        metrics = _names(value["metrics"], list(NAMES), f"{at}.metrics")
        published = str(value.get("published", ""))
        try:
            published_table(published)
        except ConfigError as e:
            raise ConfigError(f"{at}: {e}") from e
        found.append(TableSpec(str(value["title"]), form, chosen, metrics, published))
    return tuple(found)


def _names(data: Any, known: list[str], where: str) -> tuple[str, ...]:
    if not isinstance(data, list) or not data:
        raise ConfigError(f"{where}: expected a list of names, got {short(repr(data))}")
    for name in data:
        if name not in known:
            near = difflib.get_close_matches(str(name), known, n=1)
            hint = f"; perhaps you meant {near[0]}" if near else f"; known: {', '.join(known)}"
            raise ConfigError(f"{where}: unknown {short(str(name))}{hint}")
    return tuple(data)
