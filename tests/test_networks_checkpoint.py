"""Weights files: what is right is loaded, everything else is refused with one line, and nothing in a file is run."""

from __future__ import annotations

import argparse
import io
import pickle
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mastd3r.errors import MissingPackage, SlamError
from mastd3r.networks.checkpoint import CheckpointError, load_mast3r, read_state
from mastd3r.networks.mast3r import Mast3rConfig, random_mast3r

SMALL = Mast3rConfig(8, 1, 2, 8, 4, 2, (4, 4, 4, 4), 4, 4, descriptor_dim=2)
State = dict[str, torch.Tensor]
NORM, FC = "enc_norm.weight", "enc_blocks.0.mlp.fc1.weight"


@pytest.fixture(scope="module")
def whole() -> State:
    return random_mast3r(SMALL, seed=5).state_dict()


@pytest.fixture
def state(whole: State) -> State:
    return {name: value.clone() for name, value in whole.items()}


def saved(path: Path, state: dict[str, Any], **args: Any) -> Path:
    """A file in the layout of the released checkpoint."""
    torch.save({"args": argparse.Namespace(model="AsymmetricMASt3R(...)", **args), "model": state, "epoch": 3}, path)
    return path


def save_file(state: State, path: Path) -> None:
    pytest.importorskip("safetensors.torch", reason="optional package").save_file(state, path)


def without_doubles(state: State) -> State:
    return {name: value for name, value in state.items() if ".layer_rn." not in name}


def refused(path: Path, *words: str) -> None:
    """load_mast3r raises one line with the words in it."""
    with pytest.raises(SlamError) as caught:
        load_mast3r(path, SMALL)
    line = str(caught.value)
    assert "\n" not in line and path.name in line and len(line) < 700
    assert all(word in line for word in words), line


def is_loaded(path: Path, state: State, **close: float) -> None:
    model = load_mast3r(path, SMALL)
    assert not model.training and not any(p.requires_grad for p in model.parameters())
    for name, value in model.state_dict().items():
        torch.testing.assert_close(value, state[name].float(), **{"rtol": 0.0, "atol": 0.0, **close})
    assert model.downstream_head1.dpt.scratch.layer_rn[2] is model.downstream_head1.dpt.scratch.layer3_rn


# --- what is right ---------------------------------------------------------------------------------------------------


def test_the_released_layout_is_loaded(tmp_path: Path, state: State) -> None:
    is_loaded(saved(tmp_path / "a.pth", state, lr=1e-4, data=["x", None]), state)


def test_a_plain_state_is_loaded(tmp_path: Path, state: State) -> None:
    torch.save(state, tmp_path / "plain.pt")
    is_loaded(tmp_path / "plain.pt", state)


def test_safetensors_without_the_doubled_names_are_loaded(tmp_path: Path, state: State) -> None:
    save_file(without_doubles(state), tmp_path / "model.safetensors")
    is_loaded(tmp_path / "model.safetensors", state)


def test_either_of_two_doubled_names_will_do(tmp_path: Path, state: State) -> None:
    other = {n: v for n, v in state.items() if not any(f".layer{i}_rn." in n for i in range(1, 5))}
    assert len(other) == len(state) - 8
    save_file(other, tmp_path / "model.safetensors")
    is_loaded(tmp_path / "model.safetensors", state)


def test_half_precision_files_become_float32(tmp_path: Path, state: State) -> None:
    path = saved(tmp_path / "half.pth", {name: value.bfloat16() for name, value in state.items()})
    assert load_mast3r(path, SMALL).enc_norm.weight.dtype == torch.float32
    is_loaded(path, state, rtol=0.01, atol=1e-3)


# --- another network's, or half of ours ------------------------------------------------------------------------------


def _nan(state: State) -> None:
    state[FC][0, 0] = float("nan")


def _differing(state: State) -> None:
    state["downstream_head2.dpt.scratch.layer_rn.1.weight"][0] += 1


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda s: s.pop(NORM), ("names of MASt3R", "1 missing (enc_norm.weight)")),
        (lambda s: s.update(extra=s[NORM]), ("1 unexpected (extra)",)),
        (lambda s: s.update({NORM: torch.ones(9)}), ("1 of another shape (enc_norm.weight: expected (8,), got (9,))",)),
        (lambda s: [s.pop(n) for n in list(s) if "dec_blocks2" in n], ("missing (dec_blocks2.0.", ", …)")),
        (lambda s: s.update(renamed=s.pop(NORM)), ("1 missing (enc_norm.weight) · 1 unexpected (renamed)",)),
        (lambda s: s.update({NORM: torch.ones(8, dtype=torch.int64)}), ("dense floating tensor", "torch.int64")),
        (lambda s: s.update({NORM: [1.0]}), ("names and tensors, got list under 'enc_norm.weight'",)),
        (lambda s: s.update({7: torch.ones(1)}), ("names and tensors",)),
        (_nan, ("finite numbers, got inf or nan in " + FC,)),
        (_differing, ("layer2_rn", "layer_rn.1", "differ")),
        (lambda s: s.clear(), ("missing",)),
    ],
)
def test_every_name_is_accounted_for(
    tmp_path: Path, state: State, change: Callable[[State], object], words: tuple[str, ...]
) -> None:
    change(state)
    refused(saved(tmp_path / "a.pth", state), *words)


def test_something_that_is_no_state_is_refused(tmp_path: Path) -> None:
    torch.save([1, 2], tmp_path / "list.pth")
    refused(tmp_path / "list.pth", "expected a dictionary of tensors, got list")


# --- damaged ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "an empty file"),
        (b"<!doctype html><html>sign in</html>", "a web page"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:00\n", "a git-lfs pointer"),
        (pickle.dumps({"model": {}}), "a bare pickle"),
        (b"weights, honestly", "begins with"),
        (b"PK\x03\x04 and no more", "whole torch archive"),
        (b"\x50\x00\x00\x00\x00\x00\x00\x00{}   ", "whole safetensors"),
        (b"\xff\xff\xff\xff\xff\xff\xff\xff{", "begins with"),
    ],
)
def test_files_that_are_no_weights_are_refused(tmp_path: Path, content: bytes, words: str) -> None:
    path = tmp_path / "weights"
    path.write_bytes(content)
    refused(path, words)


def test_files_that_cannot_be_read_are_refused(tmp_path: Path) -> None:
    refused(tmp_path / "absent.pth", "expected weights, got no such file")
    (tmp_path / "folder.pth").mkdir()
    refused(tmp_path / "folder.pth", "expected weights, got a folder")


def test_safetensors_without_its_package_says_what_to_install(
    tmp_path: Path, state: State, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_file(without_doubles(state), tmp_path / "a.safetensors")
    monkeypatch.setitem(sys.modules, "safetensors", None)
    with pytest.raises(MissingPackage, match="pip install"):
        load_mast3r(tmp_path / "a.safetensors", SMALL)


def test_a_suffix_that_says_something_else_is_refused(tmp_path: Path, state: State) -> None:
    refused(saved(tmp_path / "a.safetensors", state), "its content is that of .pth")
    save_file(without_doubles(state), tmp_path / "b.pth")
    refused(tmp_path / "b.pth", "its content is that of .safetensors")


def test_an_archive_of_something_else_is_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.pth", "w") as archive:
        archive.writestr("readme.txt", "not weights")
    refused(tmp_path / "a.pth", "expected a torch archive of weights")


@pytest.mark.parametrize("kind", ["pth", "safetensors"])
def test_truncated_files_are_refused(tmp_path: Path, state: State, kind: str) -> None:
    path = tmp_path / f"a.{kind}"
    saved(path, state) if kind == "pth" else save_file(without_doubles(state), path)
    whole = path.read_bytes()
    for kept in (1, 5, 9, 40, 1000, len(whole) // 2, len(whole) - 200, len(whole) - 1):
        path.write_bytes(whole[:kept])
        refused(path)


def test_a_flipped_bit_is_found_or_harmless(tmp_path: Path, state: State) -> None:
    """Anywhere in the archive: refused with one line, or (unused bytes of the container) loaded as it was."""
    path = saved(tmp_path / "a.pth", state)
    whole, rng, found = path.read_bytes(), np.random.default_rng(0), 0
    with zipfile.ZipFile(path) as archive:
        text = archive.infolist()[0]  # the pickle
        spots = [int(n) for n in rng.integers(text.header_offset, text.header_offset + text.file_size, 30)]
    spots += [int(n) for n in rng.integers(0, len(whole), 30)]
    for spot in spots:
        path.write_bytes(whole[:spot] + bytes([whole[spot] ^ 1 << int(rng.integers(8))]) + whole[spot + 1 :])
        try:
            is_loaded(path, state)
        except CheckpointError as e:
            assert "\n" not in str(e)
            found += 1
    assert found > 40


def test_wrong_bytes_of_a_tensor_are_named(tmp_path: Path, state: State) -> None:
    """torch itself does not compare the checksums of its archive."""
    path = saved(tmp_path / "a.pth", state)
    data = state[FC].numpy().tobytes()
    whole = path.read_bytes()
    assert whole.count(data) == 1
    path.write_bytes(whole.replace(data, data[:-1] + bytes([data[-1] ^ 1])))
    assert torch.load(path, weights_only=False)["epoch"] == 3
    refused(path, "wrong bytes in its part")


def test_damaged_headers_of_safetensors_are_refused(tmp_path: Path, state: State) -> None:
    path = tmp_path / "a.safetensors"
    save_file(without_doubles(state), path)
    whole, rng = path.read_bytes(), np.random.default_rng(1)
    for spot in rng.integers(0, 400, 40):
        path.write_bytes(whole[:spot] + bytes([whole[spot] ^ 0x80]) + whole[spot + 1 :])
        refused(path)


# --- hostile ---------------------------------------------------------------------------------------------------------


class WritesAFile:
    """Unpickled without care, makes a file."""

    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.write_text, (self.target, "owned")


class Opens(WritesAFile):
    def __reduce__(self) -> tuple[Any, ...]:
        return open, (str(self.target), "w")


class Evaluates(WritesAFile):
    def __reduce__(self) -> tuple[Any, ...]:
        return eval, (f"open({str(self.target)!r}, 'w').close()",)


@pytest.mark.parametrize("kind", [WritesAFile, Opens, Evaluates])
@pytest.mark.parametrize("place", ["beside", "among", "in args"])
def test_a_hostile_archive_runs_nothing(tmp_path: Path, state: State, kind: type[WritesAFile], place: str) -> None:
    target = tmp_path / "owned.txt"
    hostile: dict[str, Any] = {"args": argparse.Namespace(), "model": dict(state)}
    if place == "beside":
        hostile["more"] = kind(target)
    elif place == "among":
        hostile["model"]["more"] = kind(target)
    else:
        hostile["args"].more = kind(target)
    path = tmp_path / "a.pth"
    torch.save(hostile, path)
    target.unlink(missing_ok=True)
    refused(path, "refused, nothing was run", "expected tensors and plain containers only")
    assert not target.exists()
    torch.load(path, weights_only=False)  # the file would have done it
    assert target.exists()


def test_a_hostile_archive_that_other_code_has_allowed_is_still_refused(tmp_path: Path) -> None:
    path, target = tmp_path / "a.pth", tmp_path / "owned.txt"
    torch.save({"model": {"a": Opens(target)}}, path)
    target.unlink(missing_ok=True)
    before = torch.serialization.get_safe_globals()
    try:
        torch.serialization.add_safe_globals([open])
        refused(path, "nothing was run")
        assert open in torch.serialization.get_safe_globals()  # given back as it was
    finally:
        torch.serialization.clear_safe_globals()
        torch.serialization.add_safe_globals(before)
    assert not target.exists()


def test_a_hostile_bare_pickle_is_not_opened(tmp_path: Path) -> None:
    path, target = tmp_path / "a.pth", tmp_path / "owned.txt"
    path.write_bytes(pickle.dumps(Opens(target)))
    refused(path, "a bare pickle")
    assert not target.exists()


def test_the_constructor_text_of_a_file_is_not_evaluated(tmp_path: Path, state: State) -> None:
    target = tmp_path / "owned.txt"
    path = tmp_path / "a.pth"
    args = argparse.Namespace(model=f"open({str(target)!r}, 'w')")
    torch.save({"args": args, "model": state}, path)
    is_loaded(path, state)
    assert not target.exists()


def test_an_environment_that_asks_for_unsafe_loading_is_not_obeyed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, target = tmp_path / "a.pth", tmp_path / "owned.txt"
    torch.save({"model": {"a": Opens(target)}}, path)
    target.unlink(missing_ok=True)
    monkeypatch.setenv("TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD", "1")
    refused(path, "nothing was run")
    assert not target.exists()


def test_a_tensor_that_claims_to_be_huge_costs_no_memory(tmp_path: Path, state: State) -> None:
    state[FC] = torch.zeros(1).expand(2**20, 2**22)  # 16 TiB if it were copied
    buffer = io.BytesIO()
    torch.save({"model": state}, buffer)
    (tmp_path / "a.pth").write_bytes(buffer.getvalue())
    refused(tmp_path / "a.pth", "of another shape")
    assert read_state(tmp_path / "a.pth")[FC].shape == (2**20, 2**22)
